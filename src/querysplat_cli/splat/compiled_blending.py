"""Blending and its derivative, compiled.

Tiles are blended independently, one Gaussian after the other, LANES pixels at a time: the WIDE pixels of PAIRED rows.
The inner loops over `c` have constant length and no branches, and become a few vector instructions.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_memory import prefetch, scratch
from querysplat_cli.splat.compiled_pixels import (
    BLENDED_PLANES,
    ONE,
    PIXELS,
    PLANE_PIXELS,
    any_open,
    clear,
    copy_tile,
    fill_alpha,
    fill_products,
    let_light_in,
)
from querysplat_cli.splat.compiled_projection import (
    BLUE,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    LOST,
    RED,
    A,
    B,
    C,
    X,
    Y,
)
from querysplat_cli.splat.compiled_sums import LANES, SUMS, add_sums
from querysplat_cli.splat.compiled_tiles import HALF, HIGH, WIDE, ZERO

PAIRED = LANES // WIDE
"""Rows of a tile that are blended together."""
GROUPS = HIGH // PAIRED
"""Groups of so many rows in a tile."""
LANE_SUMS = SUMS * LANES

OFFSET, BELOW, ACROSS, TILTED, UP, FAINT, BEGIN, END = range(8)
"""What is found out ahead about a Gaussian in a tile: a quarter of A·dx, and dy, at the centre of the first pixel; a
quarter of A, B and C; an eighth of LOST; and the groups of rows that the ellipse α ≥ alpha_min meets, the first one and
the one after the last."""
AHEAD = 8
BATCH = 32
"""Gaussians that are looked at ahead, and those between two looks at what is still open."""
AHEAD_NUMBERS = AHEAD * BATCH
SLACK = np.float32(1e-3)
"""Pixels, and share of the height, that rounding may cut off an ellipse at most."""
QUARTER = np.float32(0.25)
EIGHTH = np.float32(0.125)
# exp(−8s) is the 8th power of a polynomial in s, fitted on [0, 3/4]: relative error 2.5e-6 with rounding.
LIMIT = np.float32(0.75)
E0, E1, E2, E3, E4, E5 = (
    np.float32(c) for c in (0.99999988, -0.99998954, 0.49984700, -0.16582604, 0.039522059, -0.0056987114)
)


@nb.njit(error_model="numpy", fastmath={"contract"}, inline="always")
def _alpha(across, up, lost, alpha_max, alpha_min):
    """α of one pixel, min(cap, exp(−8(across² + up² + lost))) or 0; the same bits forward and backward."""
    s = min(across * across + (up * up + lost), LIMIT)
    t = s * s
    e = (E0 + s * E1) + t * ((E2 + s * E3) + t * (E4 + s * E5))
    e *= e
    e *= e
    e *= e
    alpha = min(e, alpha_max)
    return alpha if alpha >= alpha_min else ZERO


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _look_ahead(rows, members, batch, left, top, ahead):
    """Fill `ahead` for a batch of Gaussians, and ask for the rows of the next one."""
    last = len(members) - 1
    for k in range(BATCH):
        prefetch(rows, members[np.uint64(min(batch + k + BATCH, last))])
        row = rows[np.uint32(members[np.uint64(min(batch + k, last))])]
        ahead[OFFSET, k], ahead[BELOW, k] = row[X], row[Y]
        ahead[ACROSS, k], ahead[TILTED, k], ahead[UP, k] = row[A], row[B], row[C]
        ahead[FAINT, k], ahead[BEGIN, k] = row[LOST], row[HALF_HEIGHT]
    for k in range(BATCH):
        a, b, q, half = ahead[ACROSS, k], ahead[TILTED, k], ahead[UP, k], ahead[BEGIN, k]
        low = np.float32(left) + HALF - ahead[OFFSET, k]
        high = low + np.float32(WIDE - 1)
        below = np.float32(top) + HALF - ahead[BELOW, k]
        # The ellipse is (a·x + b·y)² + (q·y)² ≤ (q·half)².
        part = ONE / (b * b + q * q)
        tilt, reach, steep = -a * b * part, q * q * half * half, a * a * q * q * part
        lowest = -b / a * half
        x = min(max(lowest, low), high)
        down = half if x == lowest else np.sqrt(max(ZERO, (reach - steep * x * x) * part)) + tilt * x
        x = min(max(-lowest, low), high)
        up = half if x == -lowest else np.sqrt(max(ZERO, (reach - steep * x * x) * part)) - tilt * x
        slack = SLACK + SLACK * half
        first = min(max(np.floor(np.ceil(-below - up - slack) * HALF), ZERO), np.float32(GROUPS))
        ahead[BEGIN, k] = first
        ahead[END, k] = min(max(np.floor((down + slack - below) * HALF) + ONE, first), np.float32(GROUPS))
        ahead[OFFSET, k], ahead[BELOW, k] = QUARTER * a * low, below
        ahead[ACROSS, k], ahead[TILTED, k], ahead[UP, k] = QUARTER * a, QUARTER * b, QUARTER * q
        ahead[FAINT, k] = EIGHTH * ahead[FAINT, k]


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _blend_tile(rows, members, left, top, limits, planes):
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    # How much light still comes through each pixel; negative once the pixel has stopped.
    light, rows_within, blended = scratch(PIXELS), scratch(PIXELS), scratch(PLANE_PIXELS)
    through, ys = nb.carray(light, (GROUPS, LANES)), nb.carray(rows_within, (GROUPS, LANES))
    sums = nb.carray(blended, (BLENDED_PLANES, GROUPS, LANES))
    ahead = nb.carray(scratch(AHEAD_NUMBERS), (AHEAD, BATCH))
    let_light_in(light, rows_within, planes.shape[2] - left, planes.shape[1] - top)
    clear(blended)
    for batch in range(0, len(members), BATCH):
        _look_ahead(rows, members, batch, left, top, ahead)
        for k in range(batch, min(batch + BATCH, len(members))):
            member, i = np.uint32(members[np.uint64(k)]), np.uint64(k - batch)
            row = rows[member]
            a, b, q, lost = ahead[ACROSS, i], ahead[TILTED, i], ahead[UP, i], ahead[FAINT, i]
            offset, below = ahead[OFFSET, i], ahead[BELOW, i]
            for g in range(np.uint64(ahead[BEGIN, i]), np.uint64(ahead[END, i])):
                for c in range(LANES):
                    y = below + ys[g, c]
                    across = (offset + a * np.float32(c % WIDE)) + b * y
                    alpha = _alpha(across, q * y, lost, alpha_max, alpha_min)
                    t = through[g, c]
                    before = max(t, ZERO)
                    weight = before * alpha
                    after = before - weight
                    goes_on = after > least
                    weight = weight if goes_on else ZERO
                    through[g, c] = after if goes_on else -abs(t)
                    sums[0, g, c] += weight * row[RED]
                    sums[1, g, c] += weight * row[GREEN]
                    sums[2, g, c] += weight * row[BLUE]
                    sums[4, g, c] += weight * row[DEPTH]
        if not any_open(light):
            break
    fill_alpha(blended, light)
    copy_tile(blended, planes, left, top, True)


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _blend_tile_backward(rows, members, left, top, limits, planes, given, out):
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    light, rows_within, total = scratch(PIXELS), scratch(PIXELS), scratch(PIXELS)
    blended, asked, summed = scratch(PLANE_PIXELS), scratch(PLANE_PIXELS), scratch(LANE_SUMS)
    through, ys = nb.carray(light, (GROUPS, LANES)), nb.carray(rows_within, (GROUPS, LANES))
    behind, slopes = nb.carray(total, (GROUPS, LANES)), nb.carray(asked, (BLENDED_PLANES, GROUPS, LANES))
    lanes, ahead = nb.carray(summed, (SUMS, LANES)), nb.carray(scratch(AHEAD_NUMBERS), (AHEAD, BATCH))
    let_light_in(light, rows_within, planes.shape[2] - left, planes.shape[1] - top)
    clear(blended)
    clear(asked)
    copy_tile(blended, planes, left, top, False)
    copy_tile(asked, given, left, top, False)
    fill_products(total, asked, blended)
    for batch in range(0, len(members), BATCH):
        _look_ahead(rows, members, batch, left, top, ahead)
        for k in range(batch, min(batch + BATCH, len(members))):
            prefetch(out, members[min(k + BATCH, len(members) - 1)])
            member, i = np.uint32(members[np.uint64(k)]), np.uint64(k - batch)
            row = rows[member]
            a, b, q, lost = ahead[ACROSS, i], ahead[TILTED, i], ahead[UP, i], ahead[FAINT, i]
            offset, below = ahead[OFFSET, i], ahead[BELOW, i]
            lanes[:, :] = ZERO
            for g in range(np.uint64(ahead[BEGIN, i]), np.uint64(ahead[END, i])):
                for c in range(LANES):
                    y = below + ys[g, c]
                    across = (offset + a * np.float32(c % WIDE)) + b * y
                    alpha = _alpha(across, q * y, lost, alpha_max, alpha_min)
                    t = through[g, c]
                    before = max(t, ZERO)
                    weight = before * alpha
                    after = before - weight
                    goes_on = after > least
                    weight = weight if goes_on else ZERO
                    alpha = alpha if goes_on else ZERO
                    through[g, c] = after if goes_on else -abs(t)
                    value = slopes[0, g, c] * row[RED] + slopes[1, g, c] * row[GREEN] + slopes[2, g, c] * row[BLUE]
                    value += slopes[3, g, c] + slopes[4, g, c] * row[DEPTH]
                    rest = behind[g, c] - weight * value
                    behind[g, c] = rest
                    # −∂loss/∂σ; none through the cap.
                    slope = weight * value - rest * (alpha / (ONE - alpha))
                    slope = slope if alpha < alpha_max else ZERO
                    lanes[0, c] += slope
                    lanes[1, c] += slope * y
                    lanes[2, c] += slope * y * y
                    lanes[3, c] += weight * slopes[0, g, c]
                    lanes[4, c] += weight * slopes[1, g, c]
                    lanes[5, c] += weight * slopes[2, g, c]
                    lanes[6, c] += weight * slopes[4, g, c]
            add_sums(summed, np.float32(left) + HALF - row[X], out, member)
        if not any_open(light):
            break


@nb.njit(cache=True, error_model="numpy", parallel=True)
def blend(rows, starts, lists, tiles_x, limits, planes):
    """planes [BLENDED_PLANES, height, width] of one view, colour on black. `limits`: alpha_max, alpha_min, T_min."""
    for tile in nb.prange(len(starts) - 1):
        left, top = (tile % tiles_x) * WIDE, (tile // tiles_x) * HIGH
        _blend_tile(rows, lists[starts[tile] : starts[tile + 1]], left, top, limits, planes)


@nb.njit(cache=True, error_model="numpy", parallel=True)
def blend_backward(rows, starts, lists, bounds, tiles_x, limits, planes, given, parts):
    """Fill parts [tasks, n, ROW_COLUMNS], gradients of projected rows from `given` = ∂loss/∂planes.

    Task t owns tiles bounds[t] to bounds[t + 1] and the slice parts[t], so nothing is shared and the sum does
    not depend on timing. Gaussians are visited front to back: what is behind one is the total minus what is in front.
    """
    for task in nb.prange(len(bounds) - 1):
        parts[task] = 0
        for tile in range(bounds[task], bounds[task + 1]):
            left, top = (tile % tiles_x) * WIDE, (tile // tiles_x) * HIGH
            members = lists[starts[tile] : starts[tile + 1]]
            _blend_tile_backward(rows, members, left, top, limits, planes, given, parts[task])
