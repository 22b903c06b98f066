"""Scores compared with closed forms."""

import math

import pytest
import torch

from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views


@pytest.mark.parametrize(("background", "decibels"), [(0.0, 6.0206), (0.25, 12.0412), (1.0, 6.0206)])
def test_what_no_gaussian_covers_is_the_background(background: float, decibels: float) -> None:
    """The PSNR of a grey picture against a grey photo is −20·lg of their difference."""
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 10], [0, 20, 8], [0, 0, 1]]]), height=16, width=20)
    views = Views(torch.full((1, 3, 16, 20), 0.5), torch.ones(1, 16, 20, dtype=torch.bool), ("a.png",), ((16, 20),))
    behind = Gaussians(
        torch.tensor([[0.0, 0, -3]]), torch.eye(4)[:1], torch.full((1, 3), 0.1), torch.full((1,), 0.9),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    found = score(behind, views, camera, background)
    assert found.psnr == pytest.approx(decibels, abs=1e-3)
    assert found.background == background
    assert found.psnr_grey == math.inf
