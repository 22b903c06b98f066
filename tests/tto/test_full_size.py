"""Optimisation on large photos: the plan, and what it does to a coarse scene."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F
from tto_scenes import wall

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.full_size import FullSizeResult, PhotoFacts, optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage, Photos, TimeLimit, plan_full_size
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.options import TtoSettings, TtoStep
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 72
LARGE = Photos(20, 1200, 1600, 448)


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


def test_the_rate_falls_with_the_square_root_of_many_photos() -> None:
    rates = {count: plan_full_size("max", replace(LARGE, count=count), 10_000) for count in (5, 12, 48)}
    assert [plan.stages[0].settings.lr / FULL_SIZE_POLICY.learning_rate for plan in rates.values()] == [1, 1, 0.5]
    assert all(plan.round and plan.round.settings.lr == plan.stages[0].settings.lr / 2 for plan in rates.values())


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


@pytest.mark.parametrize("level", ["standard", "high", "max"])
def test_large_photos_of_long_plans_are_seen_from_farther_away_too(level: FullSizeLevel) -> None:
    large, small = (plan_full_size(level, photos, 40_000) for photos in (LARGE, replace(LARGE, height=360, width=480)))
    assert {each.halved for each in large.stages} == {FULL_SIZE_POLICY.levels[level].halved}
    assert {each.halved for each in small.stages} == {0.0}
    assert large.round is None or large.round.halved == FULL_SIZE_POLICY.levels[level].halved


def test_the_plan_goes_from_coarse_to_fine() -> None:
    plan = plan_full_size("high", LARGE, 50_000)
    assert [each.max_size for each in plan.stages] == [800, 1600]
    assert 50_000 < plan.stages[0].gaussians < plan.stages[1].gaussians == FULL_SIZE_POLICY.levels["high"].gaussians
    assert all(each.settings.seconds is None for each in plan.stages)
    assert plan.round is None
    assert 300 < plan.seconds < 600


def test_small_photos_have_one_stage_and_few_photos_have_few_steps() -> None:
    (only,) = plan_full_size("high", replace(LARGE, height=480, width=640), 40_000).stages
    assert only.max_size == 640
    few = plan_full_size("high", replace(LARGE, count=2), 40_000)
    assert sum(each.settings.steps for each in few.stages) <= 2 * TTO_POLICY.passes
    assert all(each.settings.keep_cover for each in few.stages)
    assert not any(each.settings.keep_cover for each in plan_full_size("high", LARGE, 40_000).stages)


def test_only_photos_that_are_shown_often_have_dropout() -> None:
    often, seldom = plan_full_size("high", LARGE, 40_000), plan_full_size("standard", Photos(20, 336, 448, 448), 40_000)
    assert {each.settings.dropout for each in often.stages} == {FULL_SIZE_POLICY.dropout}
    assert {each.settings.dropout for each in seldom.stages} == {0.0}


@pytest.mark.parametrize(("seconds", "dropout"), [(60.0, 0.0), (4000.0, FULL_SIZE_POLICY.dropout)])
def test_a_budget_has_dropout_only_if_its_time_shows_photos_often(seconds: float, dropout: float) -> None:
    """Its steps end by the clock; their limit says nothing about how many there will be."""
    plan = plan_full_size("high", LARGE, 40_000, limit=TimeLimit(seconds))
    assert {each.settings.dropout for each in plan.stages} == {dropout}


def test_photos_without_more_pixels_are_shown_less_often() -> None:
    def passes(level: FullSizeLevel, width: int, count: int = 8) -> float:
        photos = Photos(count, width * 3 // 4, width, 448)
        return sum(each.settings.steps for each in plan_full_size(level, photos, 30_000).stages) / count

    for level in ("standard", "high"):
        assert passes(level, 448) == passes(level, 300) == FULL_SIZE_POLICY.levels[level].passes
        assert passes(level, 448) < passes(level, 800) <= FULL_SIZE_POLICY.most_passes


@pytest.mark.parametrize("level", ["high", "max"])
def test_splitting_never_aims_below_the_gaussians_that_there_are(level: str) -> None:
    plan = plan_full_size(level, replace(LARGE, count=3), 900_000)  # type: ignore[arg-type]
    assert {each.gaussians for each in plan.stages} == {900_000}


def test_a_number_of_gaussians_that_the_user_asked_for_is_kept() -> None:
    plan = plan_full_size("standard", LARGE, 10_000, most=10_000)
    assert {each.gaussians for each in plan.stages} == {10_000}
    assert plan_full_size("standard", LARGE, 10_000, most=20_000).stages[-1].gaussians == 20_000


def test_max_uses_the_whole_photos_and_goes_on_in_rounds() -> None:
    photos = replace(LARGE, height=3000, width=4000)
    high, largest = plan_full_size("high", photos, 50_000), plan_full_size("max", photos, 50_000)
    assert high.stages[-1].max_size == 1600
    assert largest.stages[-1].max_size == 4000
    assert largest.round
    assert largest.seconds > 2 * high.seconds


def test_standard_shows_each_photo_often_enough_in_its_seconds() -> None:
    """Up to a number of photos all share the same seconds, and become smaller. More have seconds of their own."""
    limits, counts = FULL_SIZE_POLICY.levels["standard"], (6, 12, 16, 24, 90)
    plans = [plan_full_size("standard", replace(LARGE, count=count), 40_000) for count in counts]
    sizes = [plan.stages[-1].max_size for plan in plans]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] <= limits.size
    assert sizes[-1] > 1.5 * LARGE.working
    for count, plan in zip(counts, plans, strict=True):
        assert plan.seconds <= max(limits.most_seconds, limits.seconds_per_photo * count)
        assert sum(each.settings.steps for each in plan.stages) >= FULL_SIZE_POLICY.fewest_passes * count


def test_many_photos_have_more_gaussians_up_to_a_number() -> None:
    """Those of 480 pixels have too few pixels to be worth more than the numbers for each photo."""
    limits = FULL_SIZE_POLICY.levels["standard"]
    small = replace(LARGE, height=360, width=480)
    plans = [plan_full_size("standard", replace(small, count=count), 40_000) for count in (6, 25, 30, 90)]
    found = [plan.stages[-1].gaussians for plan in plans]
    assert found == [
        limits.shared_gaussians,
        limits.shared_gaussians,
        30 * limits.gaussians_per_photo,
        limits.gaussians,
    ]


def test_large_photos_have_more_gaussians_as_far_as_the_time_lasts() -> None:
    few, many = (plan_full_size("standard", replace(LARGE, count=count), 40_000) for count in (6, 12))
    assert few.stages[-1].gaussians == FULL_SIZE_POLICY.levels["standard"].shared_gaussians
    assert many.stages[-1].gaussians > 1.5 * few.stages[-1].gaussians
    assert many.stages[-1].max_size == few.stages[-1].max_size
    short, long = (
        plan_full_size("high", LARGE, 50_000, limit=TimeLimit(seconds)).stages[-1] for seconds in (120.0, 1000.0)
    )
    assert short.max_size == long.max_size == LARGE.width
    assert short.gaussians < long.gaussians == FULL_SIZE_POLICY.levels["high"].gaussians


def test_photos_hardly_larger_than_the_working_pictures_are_used_at_that_size() -> None:
    (only,) = plan_full_size("high", replace(LARGE, height=360, width=480), 40_000).stages
    assert only.max_size == LARGE.working


def test_a_short_time_makes_the_photos_smaller_but_never_smaller_than_the_scene() -> None:
    sizes = [
        plan_full_size("high", LARGE, 50_000, limit=TimeLimit(s)).stages[-1].max_size for s in (1.0, 40.0, 60.0, 2000.0)
    ]
    assert sizes[0] == LARGE.working
    assert sizes == sorted(sizes)
    assert sizes[1] < sizes[2] < sizes[3] == 1600


def test_a_given_time_ends_the_stages_by_the_clock() -> None:
    plan = plan_full_size("high", LARGE, 50_000, limit=TimeLimit(100.0))
    assert sum(each.settings.seconds or 0 for each in plan.stages) == pytest.approx(100)
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
