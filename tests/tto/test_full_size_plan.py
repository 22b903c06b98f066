"""The plan of an optimisation on large photos."""

from dataclasses import replace

import pytest

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.tto.full_size_plan import Photos, TimeLimit, plan_full_size
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.policy import TTO_POLICY

LARGE = Photos(20, 1200, 1600, 448)


def test_the_rate_falls_with_the_square_root_of_many_photos() -> None:
    rates = {count: plan_full_size("max", replace(LARGE, count=count), 10_000) for count in (5, 12, 48)}
    assert [plan.stages[0].settings.lr / FULL_SIZE_POLICY.learning_rate for plan in rates.values()] == [1, 1, 0.5]
    assert all(plan.round and plan.round.settings.lr == plan.stages[-1].settings.lr / 2 for plan in rates.values())


def test_a_stage_that_goes_on_starts_at_a_lower_rate() -> None:
    first, second = (stage.settings.lr for stage in plan_full_size("high", LARGE, 10_000).stages)
    (only,) = plan_full_size("standard", LARGE, 10_000).stages
    assert second == FULL_SIZE_POLICY.later_rate * first
    assert only.settings.lr == first


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


def test_only_stages_that_show_photos_often_have_dropout() -> None:
    plans = (
        plan_full_size("high", LARGE, 40_000),
        plan_full_size("high", Photos(8, 480, 640, 448), 40_000),
        plan_full_size("standard", Photos(20, 336, 448, 448), 40_000),
    )
    assert [[each.settings.dropout for each in plan.stages] for plan in plans] == [
        [FULL_SIZE_POLICY.dropout, 0.0],
        [FULL_SIZE_POLICY.dropout],
        [0.0],
    ]


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


def test_a_given_time_is_shared_by_the_stages() -> None:
    plan = plan_full_size("high", LARGE, 50_000, limit=TimeLimit(100.0))
    assert sum(each.settings.seconds or 0 for each in plan.stages) == pytest.approx(100)
