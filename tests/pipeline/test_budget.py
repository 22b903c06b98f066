"""How a time budget is divided."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.pipeline.budget import Budget, working_size
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.tto.plan import automatic_steps, plan_tto
from querysplat_cli.tto.policy import TTO_POLICY


def spent(seconds: float, of: float) -> Budget:
    return Budget(float(of), lambda: float(seconds))


@given(st.floats(5, 600), st.integers(2, 60), st.integers(1, 2), st.integers(200, 4000), st.integers(200, 4000))
def test_pictures_are_as_large_as_the_time_allows(
    seconds: float, photos: int, passes: int, height: int, width: int
) -> None:
    smallest = PRUNE_POLICY.smallest_size
    size = working_size(spent(0.0, seconds), photos, passes, (height, width), 448)
    assert smallest <= size <= 448
    assert size <= working_size(spent(0.0, 2 * seconds), photos, passes, (height, width), 448)
    assert size % 32 == 0  # so that a run that goes on finds the size of the stopped one
    if size > smallest:
        pixels = size**2 * min(height, width) / max(height, width)
        assert PIPELINE_POLICY.pixel_seconds * pixels * photos <= 0.4 * seconds


def test_optimisation_takes_what_writing_leaves() -> None:
    assert spent(20.0, of=90.0).optimising(100_000).seconds == 70 - 1.5 - 0.4
    assert spent(50.0, of=40.0).optimising(100_000).seconds == 0


def test_a_time_limit_leaves_the_number_of_steps() -> None:
    (free,), (run,) = (plan_tto(None, views=5, gaussians=1000, seconds=seconds) for seconds in (None, 3.0))
    assert run.settings.steps == free.settings.steps
    assert run.settings.seconds == 3.0
    features, gaussians = plan_tto(None, views=5, gaussians=1000, seconds=3.0, space="both")
    assert features.settings.seconds == gaussians.settings.seconds == 1.5


def test_both_goes_on_slowly_only_in_the_space_that_was_optimised() -> None:
    features, gaussians = plan_tto(8, views=5, gaussians=1000, space="both", resumed=["features"])
    assert (features.settings.lr, gaussians.settings.lr) == (TTO_POLICY.resumed_learning_rate, TTO_POLICY.learning_rate)
    assert (features.settings.warm_up, gaussians.settings.warm_up) == (TTO_POLICY.resumed_warm_up, 0)


def test_each_of_many_photos_is_seen_as_often_in_a_draft() -> None:
    """Where the photos themselves follow, more steps before them help nothing."""
    many = TTO_POLICY.many_views
    steps = {
        (views, alone): automatic_steps(views, 60_000, None, "features", alone=alone)
        for views in (8, many, 3 * many)
        for alone in (False, True)
    }
    assert len({steps[8, False], steps[8, True], steps[many, True], steps[3 * many, False]}) == 1
    shorter = automatic_steps(8, 60_000, None, "features", seconds=TTO_POLICY.work_seconds_before)
    assert shorter < steps[8, False]
    assert abs(steps[3 * many, True] - 3 * steps[many, True]) <= 3
    assert automatic_steps(2 * many, 10, None, "gaussians", alone=True) == 2 * TTO_POLICY.most_steps


def test_steps_that_decode_nothing_are_cheaper_and_so_more() -> None:
    (decoded,) = plan_tto(None, views=5, gaussians=60_000)
    (direct,) = plan_tto(None, views=5, gaussians=60_000, space="gaussians")
    assert 1.5 * decoded.settings.steps < direct.settings.steps < 2 * decoded.settings.steps


def test_large_photos_get_the_time_that_optimisation_in_feature_space_leaves() -> None:
    """Of 240 seconds 100 are over when the optimisation begins, and 120 when it goes on."""
    now = 100.0
    time = Budget(240.0, lambda: now).optimising(0)
    assert time.seconds == 140 - 1.5
    now = 120.0
    assert time.full_size_seconds() == pytest.approx(0.8 * (120 - 1.5))
    now = 236.0
    assert time.full_size_seconds() is None
