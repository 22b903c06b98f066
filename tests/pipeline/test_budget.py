"""How a time budget is divided."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.pipeline.budget import Budget, BudgetShare, optimising_seconds, working_size
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.tto.plan import plan_tto


def spent(seconds: float, of: float) -> Budget:
    return Budget(float(of), lambda: float(seconds))


@given(st.floats(5, 600), st.integers(2, 60), st.integers(1, 2), st.integers(200, 4000), st.integers(200, 4000))
def test_pictures_are_as_large_as_the_time_allows(
    seconds: float, photos: int, scenes: int, height: int, width: int
) -> None:
    smallest = PRUNE_POLICY.smallest_size
    size = working_size(spent(0.0, seconds), photos, scenes, (height, width), 448)
    assert smallest <= size <= 448
    assert size <= working_size(spent(0.0, 2 * seconds), photos, scenes, (height, width), 448)
    if size > smallest:
        pixels = size**2 * min(height, width) / max(height, width)
        assert PIPELINE_POLICY.pixel_seconds * pixels * photos * scenes <= 0.4 * seconds


def test_two_scenes_share_what_is_left_where_it_is_enough() -> None:
    seconds, more = optimising_seconds(spent(20.0, of=90.0), 15.0, 100_000, 2)
    assert more
    assert 2 * seconds + 15 + 1.5 + 0.4 == 70
    seconds, more = optimising_seconds(spent(20.0, of=40.0), 15.0, 100_000, 2)
    assert not more
    assert seconds == 20 - 1.9
    assert optimising_seconds(spent(50.0, of=40.0), 15.0, 100_000, 1) == (0.0, False)


def test_a_time_limit_leaves_the_number_of_steps() -> None:
    (free,), (run,) = (plan_tto(None, views=5, gaussians=1000, seconds=seconds) for seconds in (None, 3.0))
    assert run.settings.steps == free.settings.steps
    assert run.settings.seconds == 3.0
    features, gaussians = plan_tto(None, views=5, gaussians=1000, seconds=3.0, space="both")
    assert features.settings.seconds == gaussians.settings.seconds == 1.5


def test_steps_that_decode_nothing_are_cheaper_and_so_more() -> None:
    (decoded,) = plan_tto(None, views=5, gaussians=60_000)
    (direct,) = plan_tto(None, views=5, gaussians=60_000, space="gaussians")
    assert 1.5 * decoded.settings.steps < direct.settings.steps < 2 * decoded.settings.steps


def test_large_photos_get_the_time_that_optimisation_in_feature_space_leaves() -> None:
    """Of 240 seconds 100 are over when the optimisation of this scene begins, and 120 when it goes on."""
    now = 100.0
    share = BudgetShare(Budget(240.0, lambda: now), 1, 60.0)
    alone, one_of_two = share.optimising(0), replace(share, scenes=2).optimising(0)
    assert (alone.seconds, alone.for_more) == (140 - 1.5, True)
    assert (one_of_two.seconds, one_of_two.for_more) == ((140 - 1.5 - 40) / 2, True)
    now = 120.0
    assert alone.full_size_seconds() == pytest.approx(0.8 * (120 - 1.5))
    assert one_of_two.full_size_seconds() == pytest.approx(0.8 * 29.25)
    now = 236.0
    assert alone.full_size_seconds() is None
