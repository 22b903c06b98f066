"""Scores compared with closed forms."""

import json

import pytest
import torch

from querysplat_cli.reporting.report import quality_entry
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.colour_correction import matrix_corrected
from querysplat_cli.splat.render import render


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
    assert found.psnr_grey == 100.0  # equal pictures
    json.dumps(quality_entry(found), allow_nan=False)


def test_corrected_scores_leave_exposure_out() -> None:
    """A photo is the render in mixed channels, and with another exposure in its right half.

    Only `psnr_half` undoes mixed channels.
    """
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 10], [0, 20, 8], [0, 0, 1]]]), height=16, width=20)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(60, 3, generator=generator) * torch.tensor([1.0, 0.8, 0.1]) - torch.tensor([0.5, 0.4, -1.0])
    some = Gaussians(
        means, torch.eye(4)[:1].repeat(60, 1), torch.full((60, 3), 0.1), torch.full((60,), 0.9),
        torch.rand(60, 1, 3, generator=generator) - 0.5,
    )  # fmt: skip
    with torch.no_grad():
        drawn = render(some, camera).colour[0].clamp(0, 1)
    mixed = torch.tensor([[0.7, 0.1, 0], [0, 0.6, 0.1], [0.1, 0, 0.8]])
    same = torch.einsum("ij,jhw->ihw", mixed, drawn) + 0.05
    halves = same.clone()
    halves[:, :, 10:] += 0.1
    found = {
        name: score(some, Views(photo[None], torch.ones(1, 16, 20, dtype=torch.bool), ("a.png",), ((16, 20),)), camera)
        for name, photo in (("same", same), ("halves", halves))
    }
    assert found["same"].psnr < 25
    assert 40 < found["same"].psnr_cc < 50
    assert found["same"].ssim_cc > 0.99
    assert found["same"].psnr_half > 50
    assert found["halves"].psnr_half == pytest.approx(20, abs=0.1)
    # The inverse of a fit enlarges what does not fit.
    assert 18 < found["halves"].psnr_cc < found["halves"].psnr_half
    assert found["halves"].summary().keys() == {"psnr", "ssim", "psnr_grey", "psnr_cc", "ssim_cc", "psnr_half"}


def test_a_picture_of_one_colour_can_be_corrected() -> None:
    grey, mask = torch.full((3, 8, 8), 0.3), torch.ones(8, 8, dtype=torch.bool)
    found = matrix_corrected(grey, torch.full((3, 8, 8), 0.7), mask)
    torch.testing.assert_close(found, torch.full((3, 8, 8), 0.7), atol=1e-4, rtol=0)
