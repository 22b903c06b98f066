"""The last optimisation of a joint scene."""

import pytest
import torch

from common.streets import stroll
from querysplat_cli.pipeline.full_size import LargePhotos
from querysplat_cli.pipeline.regions import seams
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss


class Begun(Exception):
    """An optimisation would begin now."""


def test_the_last_optimisation_has_the_loss_of_the_stages_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """With another loss it would undo in each region what that was optimised for."""
    targets: list[RenderingLoss] = []

    def begun(gaussians: Gaussians, target: RenderingLoss, *rest: object, **more: object) -> None:
        targets.append(target)
        raise Begun

    monkeypatch.setattr(seams, "optimise_gaussians", begun)
    shape, names = (4, 30, 40), ("a", "b", "c", "d")
    views = Views(torch.zeros(4, 3, 30, 40), torch.ones(shape, dtype=torch.bool), names, ((30, 36),) * 4)
    photos = LargePhotos(views, stroll(10.0, 4, 3, 30, 40), confirmed=torch.zeros(shape, dtype=torch.bool))
    speck = Gaussians(torch.zeros(1, 3), torch.eye(4)[:1], torch.ones(1, 3), torch.ones(1) / 2, torch.zeros(1, 4, 3))
    with pytest.raises(Begun):
        seams.smoothed([1, 2], photos, 40, speck, seed=0, progress=lambda text, fraction: None)
    (target,) = targets
    assert len(target.views) == 2
    assert target.ssim_weight == FULL_SIZE_POLICY.ssim_weight
    assert target.guessed(0)[0, :, :36].all()
