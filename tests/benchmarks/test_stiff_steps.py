"""Optimisation restores needles and discs, too."""

import pytest
import torch

import stiff_steps


@pytest.mark.parametrize("shape", stiff_steps.SHAPES)
def test_the_shortest_axis_does_not_set_the_step(shape: str) -> None:
    kappas = torch.full((stiff_steps.COUNT,), 1e4, dtype=torch.float64)
    row = stiff_steps.measure(shape, kappas, stiff_steps.SHAPES[shape])
    assert row.before < 30
    assert row.own > 50
