"""Optimisation on large photos: what it does to a coarse scene."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.full_size import FullSizeResult, PhotoFacts, optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage
from querysplat_cli.tto.options import TtoSettings, TtoStep
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 72


def cameras(size: int, shift: float = 0.0) -> Cameras:
    w2c = torch.eye(4).repeat(4, 1, 1)
    w2c[:, 0, 3] = torch.linspace(0.15, -0.15, 4) + shift
    K = torch.tensor([[1.25 * size, 0, size / 2], [0, 1.25 * size, size / 2], [0, 0, 1]]).repeat(4, 1, 1)
    return Cameras(w2c, K, size, size)


def views_at(size: int) -> tuple[Views, Cameras]:
    """Photos of a fine wall as uint8."""
    images = (render(wall(12, size=1.2, opacity=0.97), cameras(size)).colour.clamp(0, 1) * 255).round().to(torch.uint8)
    masks = torch.ones(4, size, size, dtype=torch.bool)
    return Views(images, masks, ("a", "b", "c", "d"), ((size, size),) * 4), cameras(size)


def stage(size: int, gaussians: int, steps: int = 40, seconds: float | None = None) -> FullSizeStage:
    settings = TtoSettings(steps, 0.05, views_per_step=1, seconds=seconds, densify_after=(0.1, 0.3))
    return FullSizeStage(size, settings, gaussians)


def coarse() -> Gaussians:
    some = wall(4, size=1.2, opacity=0.97)
    return replace(some, sh=torch.zeros_like(some.sh))


def optimised(plan: FullSizePlan, seed: int = 0) -> FullSizeResult:
    return optimise_full_size(coarse(), views_at, plan, seed=seed)


TWO_STAGES = FullSizePlan((stage(36, 30), stage(SIZE, 60)), 1.0)


def test_two_stages_improve_a_view_between_the_photos() -> None:
    result = optimised(TWO_STAGES)
    assert [each.max_size for each, _ in result.runs] == [36, SIZE]
    assert [len(run.gaussians) for _, run in result.runs] == [30, 60]
    assert result.ended == "every planned step was taken"
    between = cameras(SIZE, shift=0.05)
    truth = render(wall(12, size=1.2, opacity=0.97), between).colour.clamp(0, 1)
    errors = [float((render(some, between).colour - truth).square().mean()) for some in (coarse(), result.gaussians)]
    assert errors[1] < 0.6 * errors[0]


def test_the_same_seed_gives_the_same_gaussians() -> None:
    one, two, other = optimised(TWO_STAGES), optimised(TWO_STAGES), optimised(TWO_STAGES, seed=1)
    assert all(a.equal(b) for a, b in zip(one.gaussians.tensors(), two.gaussians.tensors(), strict=True))
    assert not one.gaussians.means.equal(other.gaussians.means)


def test_only_pictures_of_one_size_are_asked_for_at_a_time() -> None:
    asked = []

    def counted(size: int) -> tuple[Views, Cameras]:
        asked.append(size)
        return views_at(size)

    plan = FullSizePlan((stage(36, 20, 3), stage(36, 24, 3), stage(SIZE, 24, 3)), 1.0)
    optimise_full_size(coarse(), counted, plan, seed=0)
    assert asked == [36, SIZE]


def test_similarity_weighs_as_the_policy_says() -> None:
    result = optimised(FullSizePlan((stage(36, 16, 1),), 1.0))
    views, some = views_at(36)
    target = replace(RenderingLoss.for_solid_scenes(views, some, torch.Generator()), ssim_weight=0.4)
    assert result.runs[0][1].loss_before == pytest.approx(target.value(coarse(), [0, 1, 2, 3]), rel=1e-5)


def test_rounds_end_when_the_loss_stops_falling() -> None:
    """A rate that moves nothing gains nothing, so the first round is the last."""
    idle = replace(stage(SIZE, 16), settings=TtoSettings(4, 1e-9, views_per_step=1))
    result = optimised(FullSizePlan((stage(SIZE, 20),), 1.0, idle, 5))
    assert len(result.runs) == 2
    assert "stopped falling" in result.ended
    busy = replace(stage(SIZE, 20), settings=TtoSettings(12, 0.02, views_per_step=1))
    result = optimised(FullSizePlan((stage(SIZE, 20, 4),), 1.0, busy, 2))
    assert (len(result.runs), result.ended) == (3, "2 rounds were taken")


def test_ctrl_c_keeps_what_was_reached_and_begins_no_other_stage() -> None:
    def interrupt(_: FullSizeStage, step: TtoStep) -> None:
        if step.step == 20:
            raise KeyboardInterrupt

    result = optimise_full_size(coarse(), views_at, TWO_STAGES, seed=0, progress=interrupt)
    assert result.interrupted
    assert len(result.runs) == 1
    assert result.ended == "Ctrl-C"
    assert len(result.gaussians) > 16


def test_gradients_are_over_changing_backgrounds_and_losses_over_grey() -> None:
    views, some = views_at(36)
    faint = replace(coarse(), opacities=torch.full((16,), 0.3))
    target = RenderingLoss(views, some, torch.full((3,), 0.5), backgrounds=torch.Generator().manual_seed(0))
    steps = [target.value_and_gradient(faint, [0]) for _ in range(6)]
    assert len({float(step.gradient.opacities.sum()) for step in steps}) > 2
    assert [step.loss for step in steps] == pytest.approx([target.value(faint, [0])] * 6, rel=1e-5)


def test_halved_views_add_half_of_their_gradient() -> None:
    """As a loss of its own has it, on pictures that are halved already, over the same background."""
    views, some = views_at(SIZE)
    smaller = replace(
        views,
        images=F.avg_pool2d(views.images.float() / 255, 2),
        masks=views.masks[:, ::2, ::2],
        sizes=((SIZE // 2, SIZE // 2),) * 4,
    )

    def gradient(what: Views, where: Cameras, halved: float) -> list[torch.Tensor]:
        target = RenderingLoss.for_solid_scenes(what, where, torch.Generator().manual_seed(1))
        return replace(target, halved=halved).value_and_gradient(coarse(), [2]).gradient.tensors()

    half = gradient(smaller, some.resized(SIZE // 2, SIZE // 2), 0.0)
    for whole, both, other in zip(gradient(views, some, 0.0), gradient(views, some, 1.0), half, strict=True):
        torch.testing.assert_close(both, whole + TTO_POLICY.half * other, rtol=1e-4, atol=1e-7)


def test_a_given_time_ends_the_stages_by_the_clock() -> None:
    assert optimised(FullSizePlan((stage(36, 20, 10_000, seconds=0.2),), 0.2)).ended == "the time was over"


def test_depth_is_kept_smooth_in_all_stages_where_no_view_confirms_it() -> None:
    def means(confirmed: torch.Tensor | None) -> torch.Tensor:
        facts = PhotoFacts(confirmed=None if confirmed is None else tuple(confirmed))
        return optimise_full_size(coarse(), views_at, TWO_STAGES, seed=0, facts=facts).gaussians.means

    everywhere = torch.ones(4, 36, 36, dtype=torch.bool)
    plain = means(None)
    assert means(everywhere).equal(plain)
    depths = [float((each[:, 2] - 2).abs().mean()) for each in (plain, means(~everywhere))]
    assert depths[1] < depths[0]


def test_colour_transforms_go_through_all_stages() -> None:
    """Photos 1 and 3 are darker. Transforms find that out, and the scene keeps the colours of the mean photo."""
    gains = torch.tensor([1.0, 0.7, 1.0, 0.7])

    def dimmed(size: int) -> tuple[Views, Cameras]:
        views, where = views_at(size)
        return replace(views, images=(views.images * gains[:, None, None, None]).to(torch.uint8)), where

    start = Exposures.identity(4)
    found = optimise_full_size(coarse(), dimmed, TWO_STAGES, seed=0, facts=PhotoFacts(start)).exposures
    assert found
    torch.testing.assert_close(found.matrices.mean(0), start.matrices[0])
    brightness = found.matrices[:, :, :3].sum(2).mean(1) + 2 * found.matrices[:, :, 3].mean(1)
    torch.testing.assert_close(brightness.float(), gains / gains.mean(), atol=0.06, rtol=0)
    assert optimised(TWO_STAGES).exposures is None
