"""A run that holds guesses back is kept if it makes better what several photos show."""

import math
from dataclasses import replace

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_value
from querysplat_cli.tto.gaussians import Changes, optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIDE = 32
GREY = torch.full((3,), MID_GREY)


def half_confirmed(truth: Gaussians) -> RenderingLoss:
    """One photo of a wall; the depth of its left half is confirmed."""
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])[None]
    cameras = Cameras(torch.eye(4)[None], K, SIDE, SIDE)
    photo = render(truth, cameras, background=GREY).colour.detach()
    confirmed = torch.zeros(1, SIDE, SIDE, dtype=torch.bool)
    confirmed[..., : SIDE // 2] = True
    views = Views(photo, torch.ones_like(confirmed), ("a",), ((SIDE, SIDE),))
    return RenderingLoss(views, cameras, GREY, confirmed=confirmed)


def left_half_off(truth: Gaussians) -> Gaussians:
    wrong = (truth.means[:, 0] < 0)[:, None, None] * torch.full_like(truth.sh, 0.15)
    return replace(truth, sh=truth.sh + wrong)


def test_the_loss_of_confirmed_pixels_does_not_see_the_others() -> None:
    truth = wall(12, size=1.0, opacity=0.9)
    target = half_confirmed(truth)
    start = left_half_off(truth)
    mask = target.confirmed
    assert mask is not None
    picture = render(start, target.cameras, background=GREY).colour
    expected, _ = photometric_value(picture * mask, target.views.images * mask, mask)
    assert target.value_where_confirmed(start) == pytest.approx(expected, rel=1e-6)
    assert target.value_where_confirmed(truth) < 1e-6
    nothing = replace(target, confirmed=torch.zeros_like(mask))
    assert nothing.value_where_confirmed(start) == math.inf
    assert replace(target, confirmed=None).value_where_confirmed(start) == pytest.approx(target.value(start, [0]))


def test_a_run_is_kept_that_is_worse_in_guesses_alone() -> None:
    truth = wall(12, size=1.0, opacity=0.9)
    target, start = half_confirmed(truth), left_half_off(truth)
    settings = TtoSettings(60, 0.005, densify_after=(0.05, 0.95))

    def optimised(target: RenderingLoss) -> TtoResult[Changes]:
        generator = torch.Generator().manual_seed(0)
        return optimise_gaussians(start, target, settings, generator=generator, densify_to=len(start) + 10)

    kept = optimised(target)
    assert kept.added == 10
    assert kept.loss_after > kept.loss_before
    assert target.value_where_confirmed(kept.gaussians) < 0.7 * target.value_where_confirmed(start)
    undone = optimised(replace(target, confirmed=None))
    assert undone.gaussians.means.equal(start.means)
    assert undone.loss_after == undone.loss_before
