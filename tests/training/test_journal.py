"""The curve of a training's log."""

import numpy as np
import pytest

from querysplat_cli.training.journal import CURVE_WINDOW, running_mean


@pytest.mark.parametrize(("count", "left"), [(1, 1), (2, 2), (15, 11), (3 * CURVE_WINDOW, 2 * CURVE_WINDOW + 1)])
def test_a_short_log_has_a_curve_and_not_a_point(count: int, left: int) -> None:
    steps = np.arange(float(count))
    found = running_mean(steps)
    assert len(found) == left
    assert found.mean() == pytest.approx(steps.mean())
