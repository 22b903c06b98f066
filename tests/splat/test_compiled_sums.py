"""Sums over lanes, against numpy in float64."""

import numba as nb
import numpy as np
import pytest

from querysplat_cli.splat.compiled_memory import scratch
from querysplat_cli.splat.compiled_sums import LANES, SUMS, add_sums
from querysplat_cli.splat.compiled_tiles import WIDE

NUMBERS = SUMS * LANES


@nb.njit
def _added(vectors, left, out, row):  # type: ignore[no-untyped-def]
    place = scratch(NUMBERS)
    copied = nb.carray(place, (SUMS, LANES))
    for i in range(SUMS):
        for lane in range(LANES):
            copied[i, lane] = vectors[i, lane]
    add_sums(place, left, out, row)


@pytest.mark.parametrize("left", [0.0, -3.25, 1e4])
def test_ten_sums_are_added_to_one_row(left: float) -> None:
    random = np.random.default_rng(0)
    vectors = random.standard_normal((SUMS, LANES)).astype(np.float32)
    out = random.standard_normal((3, LANES)).astype(np.float32)
    before, x = out.copy().astype(np.float64), left + np.arange(LANES) % WIDE
    _added(vectors, np.float32(left), out, 1)
    first, second = vectors[:2].astype(np.float64)
    terms = np.stack([first * x, first * x * x, second * x, *vectors.astype(np.float64)])
    before[1, : len(terms)] += terms.sum(1)
    assert (np.abs(out - before)[1, : len(terms)] <= 1e-5 * (1 + np.abs(terms).sum(1))).all()
    before[1, : len(terms)] = out[1, : len(terms)]
    assert (out == before.astype(np.float32)).all()
