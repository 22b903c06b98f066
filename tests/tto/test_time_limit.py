"""Plans of a time limit: the time decides how far they go, and on a slower machine less fits into it."""

from dataclasses import replace

import pytest

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.tto.full_size_plan import FullSizePlan, Photos, TimeLimit, plan_full_size, step_seconds
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY

PHOTOS = Photos(11, 2128, 2832, 448)


def planned(seconds: float, pace: float = 1.0, level: FullSizeLevel = "high") -> FullSizePlan:
    return plan_full_size(level, PHOTOS, 40_000, limit=TimeLimit(seconds, pace))


@pytest.mark.parametrize("seconds", [8.0, 14.0, 20.0, 30.0, 60.0, 300.0])
def test_the_time_shows_each_photo_often_enough(seconds: float) -> None:
    """14 seconds had 164,000 Gaussians, which no time was left to fit."""
    last = planned(seconds).stages[-1]
    height = PHOTOS.height * last.max_size / PHOTOS.width
    step = step_seconds(last.max_size * height, last.gaussians)
    passes = (last.settings.seconds or 0) / step / PHOTOS.count
    # A stage before it has a third of the time, and steps that see the half size, too, take longer.
    assert passes > (0.6 if len(planned(seconds).stages) > 1 else 0.85) * FULL_SIZE_POLICY.fewest_passes


@pytest.mark.parametrize(
    ("seconds", "asked", "level"),
    [
        (14.0, "standard", "standard"),
        (14.0, "max", "standard"),
        (60.0, "standard", "high"),
        (60.0, "max", "high"),
        (900.0, "max", "max"),
    ],
)
def test_the_level_follows_the_time(seconds: float, asked: FullSizeLevel, level: FullSizeLevel) -> None:
    plan = planned(seconds, level=asked)
    assert plan.level == level
    assert plan.most_rounds == 0


def test_a_slower_machine_does_less_in_the_same_time() -> None:
    slow, fast = planned(60.0, pace=2.0), planned(30.0)
    assert sum(stage.settings.seconds or 0 for stage in slow.stages) == pytest.approx(60.0)
    same = [(stage.max_size, stage.gaussians) for stage in fast.stages]
    assert [(stage.max_size, stage.gaussians) for stage in slow.stages] == same
    assert planned(60.0).stages[-1].gaussians >= slow.stages[-1].gaussians


def test_small_photos_have_the_gaussians_that_the_time_allows() -> None:
    small = replace(PHOTOS, height=336, width=448)
    targets = [plan_full_size("high", small, 40_000, limit=TimeLimit(s)).stages[-1].gaussians for s in (5.0, 60.0)]
    assert targets[0] == FULL_SIZE_POLICY.levels["standard"].shared_gaussians
    assert targets[1] > 2 * targets[0]
