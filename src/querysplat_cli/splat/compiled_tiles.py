"""The lists of Gaussians of every tile, compiled.

A picture is cut into tiles of WIDE × HIGH pixels. The Gaussians are sorted by depth once, and then assigned to the
tiles that their ellipse α ≥ alpha_min touches, so every tile's list is in depth order without a sort of its own.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

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
def tile_rows(rows, tiles_y, first, count):
    """The first row of tiles that each Gaussian's extent meets, and how many; 0 where it is not visible."""
    for i in nb.prange(len(rows)):
        top, bottom = rows[i, Y] - rows[i, HALF_HEIGHT], rows[i, Y] + rows[i, HALF_HEIGHT]
        seen = rows[i, HALF_WIDTH] > 0 and bottom > 0 and top < tiles_y * HIGH
        first[i] = int(max(top, ZERO)) // HIGH if seen else 0
        count[i] = int(min(bottom, tiles_y * HIGH - HALF)) // HIGH - first[i] + 1 if seen else 0


@nb.njit(cache=True, error_model="numpy", parallel=True)
def find_spans(rows, first, offsets, alpha_min, tiles_x, spans, counts):
    """spans [offsets[i] + r] = first tile, and the one after the last, that Gaussian i meets in its r-th row of tiles.

    counts [tasks, tiles] are the pairs that each task found: runs of Gaussians, so that nothing is shared.
    """
    bright = -2 * np.log(alpha_min)
    tasks, n = len(counts), len(rows)
    for task in nb.prange(tasks):
        for i in range(task * n // tasks, (task + 1) * n // tasks):
            if offsets[i] == offsets[i + 1]:
                continue
            x, y = np.float64(rows[i, X]), np.float64(rows[i, Y])
            a, b, q = np.float64(rows[i, A]), np.float64(rows[i, B]), np.float64(rows[i, C])
            reach = bright - 2 * np.float64(rows[i, LOST])
            half_width = np.float64(rows[i, HALF_WIDTH])
            for r in range(offsets[i + 1] - offsets[i]):
                top = (first[i] + r) * HIGH + 0.5 - y
                left, right = _row_reach(a, b, q, half_width, top, top + HIGH - 1, reach)
                left, right = x + left, x + right
                start, stop = 0, 0
                # Only pixel centres count.
                if right >= 0.5 and left <= tiles_x * WIDE - 0.5 and left <= right:
                    start = int(max(left - 0.5, 0.0)) // WIDE
                    stop = int(min(right - 0.5, tiles_x * WIDE - 1.0)) // WIDE + 1
                spans[offsets[i] + r, 0], spans[offsets[i] + r, 1] = start, stop
                for tile in range((first[i] + r) * tiles_x + start, (first[i] + r) * tiles_x + stop):
                    counts[task, tile] += 1


@nb.njit(cache=True, error_model="numpy", parallel=True)
def deal(order, first, offsets, spans, tiles_x, tiles_y, bands, starts, lists):
    """Fill the tiles' lists in the order given. Each band of tile rows is one task, so nothing is shared."""
    for band in nb.prange(bands):
        top, bottom = band * tiles_y // bands, (band + 1) * tiles_y // bands
        ends = starts[top * tiles_x : bottom * tiles_x].copy()
        for k in range(len(order)):
            i = order[k]
            skipped = offsets[i] - first[i]
            for tile_y in range(max(top, first[i]), min(bottom, first[i] + offsets[i + 1] - offsets[i])):
                row = (tile_y - top) * tiles_x
                for tile in range(row + spans[skipped + tile_y, 0], row + spans[skipped + tile_y, 1]):
                    lists[ends[tile]] = i
                    ends[tile] += 1
