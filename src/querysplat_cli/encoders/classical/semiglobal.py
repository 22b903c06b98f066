"""Semi-global matching (Hirschmüller 2008): depth that matches well and is smooth along eight paths."""

import numba as nb
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY

# Plain numbers, since a compiled kernel cannot read a dataclass.
_SMALL_STEP = DEPTH_POLICY.small_step
_LARGE_STEP = DEPTH_POLICY.large_step
_CONTRAST = DEPTH_POLICY.contrast
_OUTSIDE_COST = np.uint16(20000)
"""Path cost beyond the first and the last plane."""
_LARGEST_JUMP = np.uint16(_LARGE_STEP)
"""Penalty of a jump where there is no neighbour to compare brightness with."""


def aggregate_costs(costs: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Sum of the eight path costs [height, width, planes], as unsigned 16-bit numbers."""
    sums = np.zeros((2, *costs.shape), np.uint16)
    _two_passes(costs, grey, sums)
    sums[0] += sums[1]
    return sums[0]


def best_planes(sums: np.ndarray) -> np.ndarray:
    """The best plane of each pixel [height, width], refined between planes by a parabola."""
    plane = np.empty(sums.shape[:2], np.float32)
    _best_planes(sums, plane)
    return plane


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _two_passes(costs, grey, sums):
    for turn in nb.prange(2):
        _one_pass(costs, grey, turn, sums[turn])


@nb.njit(cache=True, error_model="numpy")
def _one_pass(costs, grey, turn, sums):
    """Pass 0 takes the four paths from above and from the left, pass 1 those from below and from the right."""
    height, width, planes = costs.shape
    step = 1 - 2 * turn
    # Path costs of the row before, one column and one plane wider on either side than the picture.
    before = np.zeros((3, width + 2, planes + 2), np.uint16)
    now = np.zeros((3, width + 2, planes + 2), np.uint16)
    lows_before = np.zeros((3, width + 2), np.uint16)
    lows_now = np.zeros((3, width + 2), np.uint16)
    along = np.zeros((2, planes + 2), np.uint16)
    for buffer in (before, now):
        buffer[:, 1 : width + 1, 0] = _OUTSIDE_COST
        buffer[:, 1 : width + 1, planes + 1] = _OUTSIDE_COST
    along[:, 0] = _OUTSIDE_COST
    along[:, planes + 1] = _OUTSIDE_COST
    for r in range(height):
        y = r if turn == 0 else height - 1 - r
        along[0, 1 : planes + 1] = 0
        low_along = np.uint16(0)
        for c in range(width):
            x = c if turn == 0 else width - 1 - c
            here = grey[y, x]
            for path in range(3):
                from_x = x + path - 1
                jump = _jump(here, grey[y - step, from_x]) if r > 0 and 0 <= from_x < width else _LARGEST_JUMP
                lows_now[path, x + 1] = _step(
                    costs[y, x],
                    before[path, from_x + 1],
                    lows_before[path, from_x + 1],
                    jump,
                    now[path, x + 1],
                    sums[y, x],
                )
            jump = _jump(here, grey[y, x - step]) if c > 0 else _LARGEST_JUMP
            low_along = _step(costs[y, x], along[c % 2], low_along, jump, along[1 - c % 2], sums[y, x])
        before, now = now, before
        lows_before, lows_now = lows_now, lows_before


@nb.njit(cache=True, error_model="numpy", inline="always")
def _jump(here, there):
    return np.uint16(max(_SMALL_STEP + 1, _LARGE_STEP / (1 + abs(here - there) / _CONTRAST)))


@nb.njit(cache=True, error_model="numpy")
def _step(cost, previous, low, jump, result, total):
    """One step of one path: fill `result` (padded by a plane on either side), add it to `total`, return its minimum."""
    least = np.uint16(65535)
    ceiling = np.uint16(low + jump)
    small = np.uint16(_SMALL_STEP)
    for d in range(len(cost)):
        best = min(previous[d + 1], np.uint16(min(previous[d], previous[d + 2]) + small))
        value = np.uint16(np.uint16(cost[d]) + min(best, ceiling) - low)
        result[d + 1] = value
        total[d] += value
        least = min(least, value)
    return least


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _best_planes(sums, plane):
    height, width, planes = sums.shape
    for y in nb.prange(height):
        for x in range(width):
            row = sums[y, x]
            best = 0
            for d in range(1, planes):
                if row[d] < row[best]:
                    best = d
            offset = 0.0
            if 0 < best < planes - 1:
                left, middle, right = float(row[best - 1]), float(row[best]), float(row[best + 1])
                bend = left - 2 * middle + right
                if bend > 0:
                    offset = min(max(0.5 * (left - right) / bend, -0.5), 0.5)
            plane[y, x] = best + offset
