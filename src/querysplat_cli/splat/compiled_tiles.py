"""The lists of Gaussians of every tile, compiled.

A picture is cut into tiles of WIDE × HIGH pixels. The Gaussians are sorted by depth once, and then assigned to the
tiles that their ellipse α ≥ alpha_min touches, so every tile's list is in depth order without a sort of its own.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_memory import prefetch
from querysplat_cli.splat.compiled_projection import HALF_HEIGHT, HALF_WIDTH, LOST, A, B, C, X, Y

WIDE, HIGH = 8, 32
HALF = np.float32(0.5)
ZERO = np.float32(0)


@nb.njit(error_model="numpy", inline="always")
def _row_reach(a, b, q, half_width, low, high, reach):
    """x-extent, relative to the centre, of the ellipse σ ≤ reach/2 between two heights above the centre."""
    furthest = -b * a * half_width / (b * b + q * q)  # height at which the ellipse reaches furthest right
    narrow, tilt = 1 / a, b / a
    y = min(max(furthest, low), high)
    right = half_width if y == furthest else np.sqrt(max(0.0, reach - q * q * y * y)) * narrow - tilt * y
    y = min(max(-furthest, low), high)
    left = -half_width if y == -furthest else -np.sqrt(max(0.0, reach - q * q * y * y)) * narrow - tilt * y
    slack = 1e-3 + 1e-4 * half_width
    return left - slack, right + slack


@nb.njit(cache=True, error_model="numpy", parallel=True)
def tile_rows(rows, order, tiles_y, first, count):
    """The first row of tiles that the extent of each Gaussian meets, in the order given, and how many."""
    for k in nb.prange(len(order)):
        y, half = rows[order[k], Y], rows[order[k], HALF_HEIGHT]
        seen = y + half > 0 and y - half < tiles_y * HIGH
        first[k] = int(max(y - half, ZERO)) // HIGH if seen else 0
        count[k] = int(min(y + half, tiles_y * HIGH - HALF)) // HIGH - first[k] + 1 if seen else 0


@nb.njit(cache=True, error_model="numpy", parallel=True)
def find_spans(rows, order, first, offsets, alpha_min, tiles_x, spans, counts):
    """spans [offsets[k] + r] = first tile, and the one after the last, that Gaussian k meets in its r-th row of tiles.

    counts [tasks, tiles] are the pairs that each task found: runs of Gaussians, so that nothing is shared.
    """
    bright = -2 * np.log(alpha_min)
    tasks, n = len(counts), len(order)
    for task in nb.prange(tasks):
        for k in range(task * n // tasks, (task + 1) * n // tasks):
            prefetch(rows, order[min(k + 16, n - 1)])
            i = order[k]
            x, y = np.float64(rows[i, X]), np.float64(rows[i, Y])
            a, b, q = np.float64(rows[i, A]), np.float64(rows[i, B]), np.float64(rows[i, C])
            reach = bright - 2 * np.float64(rows[i, LOST])
            half_width = np.float64(rows[i, HALF_WIDTH])
            for r in range(offsets[k + 1] - offsets[k]):
                top = (first[k] + r) * HIGH + 0.5 - y
                left, right = _row_reach(a, b, q, half_width, top, top + HIGH - 1, reach)
                left, right = x + left, x + right
                start, stop = 0, 0
                # Only pixel centres count.
                if right >= 0.5 and left <= tiles_x * WIDE - 0.5 and left <= right:
                    start = int(max(left - 0.5, 0.0)) // WIDE
                    stop = int(min(right - 0.5, tiles_x * WIDE - 1.0)) // WIDE + 1
                spans[offsets[k] + r, 0], spans[offsets[k] + r, 1] = start, stop
                for tile in range((first[k] + r) * tiles_x + start, (first[k] + r) * tiles_x + stop):
                    counts[task, tile] += 1


@nb.njit(cache=True, error_model="numpy", parallel=True)
def deal(order, first, offsets, spans, tiles_x, tiles_y, bands, starts, lists):
    """Fill the tiles' lists in the order given. Each band of tile rows is one task, so nothing is shared."""
    for band in nb.prange(bands):
        top, bottom = band * tiles_y // bands, (band + 1) * tiles_y // bands
        ends = starts[top * tiles_x : bottom * tiles_x].copy()
        for k in range(len(order)):
            skipped = offsets[k] - first[k]
            for tile_y in range(max(top, first[k]), min(bottom, first[k] + offsets[k + 1] - offsets[k])):
                row = (tile_y - top) * tiles_x
                for tile in range(row + spans[skipped + tile_y, 0], row + spans[skipped + tile_y, 1]):
                    lists[ends[tile]] = order[k]
                    ends[tile] += 1
