"""Blending and its derivative, compiled.

Tiles are blended independently, one Gaussian after the other, LANES pixels at a time: the WIDE pixels of PAIRED rows.
The inner loops over `c` have constant length and no branches, and become a few vector instructions.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_memory import prefetch, scratch
from querysplat_cli.splat.compiled_projection import (
    BLUE,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    LOST,
    OPACITY,
    RED,
    XX,
    XY,
    YY,
    A,
    B,
    C,
    X,
    Y,
)
from querysplat_cli.splat.compiled_tiles import HALF, HIGH, WIDE, ZERO

PIXELS = WIDE * HIGH
PAIRED = 2
"""Rows of a tile that are blended together."""
GROUPS = HIGH // PAIRED
"""Groups of so many rows in a tile."""
LANES = WIDE * PAIRED
"""Pixels of one group."""
BLENDED_PLANES = 5
"""The values that are blended: red, green, blue, 1 (for alpha) and z."""
PLANE_PIXELS = BLENDED_PLANES * PIXELS
SUMS = 7
"""The sums of the backward pass over a lane: −∂loss/∂σ times 1, dy, dy²;
red, green, blue, z."""
LANE_SUMS = SUMS * LANES

BATCH = 16
"""Gaussians between asking for a row and using it, and between two looks at what is still open."""
SLACK = np.float32(1e-3)
"""Pixels, and share of the height, that rounding may cut off an ellipse at most."""
QUARTER = np.float32(0.25)
EIGHTH = np.float32(0.125)
ONE = np.float32(1)
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
def _blend_tile(rows, members, left, top, width, height, limits, planes):
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    # How much light still comes through each pixel; negative once the pixel has stopped.
    through = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    red = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    green = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    blue = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    depth = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    ys = nb.carray(scratch(PIXELS), (GROUPS, LANES))  # of each pixel, from the tile's first row
    begins = nb.carray(scratch(BATCH), BATCH)
    ends = nb.carray(scratch(BATCH), BATCH)
    for g in range(GROUPS):
        for c in range(LANES):
            ys[g, c] = np.float32(PAIRED * g + c // WIDE)
            inside = left + c % WIDE < width and top + PAIRED * g + c // WIDE < height
            through[g, c] = ONE if inside else -ONE
            red[g, c] = ZERO
            green[g, c] = ZERO
            blue[g, c] = ZERO
            depth[g, c] = ZERO
    for batch in range(0, len(members), BATCH):
        _groups_met(rows, members, batch, left, top, begins, ends)
        for k in range(batch, min(batch + BATCH, len(members))):
            prefetch(rows, members[min(k + BATCH, len(members) - 1)])
            row = rows[members[k]]
            a, b, q = QUARTER * row[A], QUARTER * row[B], QUARTER * row[C]
            lost = EIGHTH * row[LOST]
            below = np.float32(top) + HALF - row[Y]
            offset = a * (np.float32(left) + HALF - row[X])
            for g in range(np.uint64(begins[k - batch]), np.uint64(ends[k - batch])):
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
                    red[g, c] += weight * row[RED]
                    green[g, c] += weight * row[GREEN]
                    blue[g, c] += weight * row[BLUE]
                    depth[g, c] += weight * row[DEPTH]
        if not _any_open(through):
            break
    for r in range(min(HIGH, height - top)):
        for x in range(min(WIDE, width - left)):
            g, c = r // PAIRED, (r % PAIRED) * WIDE + x
            planes[0, top + r, left + x] = red[g, c]
            planes[1, top + r, left + x] = green[g, c]
            planes[2, top + r, left + x] = blue[g, c]
            planes[3, top + r, left + x] = ONE - abs(through[g, c])
            planes[4, top + r, left + x] = depth[g, c]


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _blend_tile_backward(rows, members, left, top, width, height, limits, planes, given, out):
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    through = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    behind = nb.carray(scratch(PIXELS), (GROUPS, LANES))
    slopes = nb.carray(scratch(PLANE_PIXELS), (BLENDED_PLANES, GROUPS, LANES))
    lanes = nb.carray(scratch(LANE_SUMS), (SUMS, LANES))
    ys = nb.carray(scratch(PIXELS), (GROUPS, LANES))  # of each pixel, from the tile's first row
    begins = nb.carray(scratch(BATCH), BATCH)
    ends = nb.carray(scratch(BATCH), BATCH)
    for g in range(GROUPS):
        for c in range(LANES):
            ys[g, c] = np.float32(PAIRED * g + c // WIDE)
            through[g, c] = -ONE
            behind[g, c] = ZERO
            for plane in range(BLENDED_PLANES):
                slopes[plane, g, c] = ZERO
    for r in range(min(HIGH, height - top)):
        for x in range(min(WIDE, width - left)):
            g, c = r // PAIRED, (r % PAIRED) * WIDE + x
            through[g, c] = ONE
            for plane in range(BLENDED_PLANES):
                slopes[plane, g, c] = given[plane, top + r, left + x]
                behind[g, c] += given[plane, top + r, left + x] * planes[plane, top + r, left + x]
    for batch in range(0, len(members), BATCH):
        _groups_met(rows, members, batch, left, top, begins, ends)
        for k in range(batch, min(batch + BATCH, len(members))):
            prefetch(rows, members[min(k + BATCH, len(members) - 1)])
            prefetch(out, members[min(k + BATCH, len(members) - 1)])
            row = rows[members[k]]
            a, b, q = QUARTER * row[A], QUARTER * row[B], QUARTER * row[C]
            lost = EIGHTH * row[LOST]
            below = np.float32(top) + HALF - row[Y]
            offset = a * (np.float32(left) + HALF - row[X])
            lanes[:, :] = ZERO
            for g in range(np.uint64(begins[k - batch]), np.uint64(ends[k - batch])):
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
            _add_moments(lanes, np.float32(left) + HALF - row[X], row, out[members[k]])
        if not _any_open(through):
            break


@nb.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _add_moments(lanes, dx, row, out):
    """Add the gradient of one projected row, from the sums of −∂loss/∂σ and of the blended values over each lane."""
    m, mx, my, mxx, mxy, myy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    red, green, blue, depth = ZERO, ZERO, ZERO, ZERO
    for c in range(LANES):
        x = dx + np.float32(c % WIDE)
        m += lanes[0, c]
        mx += lanes[0, c] * x
        mxx += lanes[0, c] * x * x
        my += lanes[1, c]
        mxy += lanes[1, c] * x
        myy += lanes[2, c]
        red += lanes[3, c]
        green += lanes[4, c]
        blue += lanes[5, c]
        depth += lanes[6, c]
    across = row[A] * mx + row[B] * my
    out[X] += row[A] * across
    out[Y] += row[B] * across + row[C] * row[C] * my
    out[XX] -= HALF * mxx
    out[XY] -= mxy
    out[YY] -= HALF * myy
    out[OPACITY] += m / row[OPACITY]
    out[RED] += red
    out[GREEN] += green
    out[BLUE] += blue
    out[DEPTH] += depth


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _groups_met(rows, members, batch, left, top, begins, ends):
    """The groups of rows of a tile that the ellipses α ≥ alpha_min of a batch of Gaussians meet."""
    for k in range(BATCH):
        row = rows[members[min(batch + k, len(members) - 1)]]
        a, b, q, half = row[A], row[B], row[C], row[HALF_HEIGHT]
        low = np.float32(left) + HALF - row[X]
        high = low + np.float32(WIDE - 1)
        under = row[Y] - np.float32(top) - HALF
        # The ellipse is (a·x + b·y)² + (q·y)² ≤ (q·half)².
        part = ONE / (b * b + q * q)
        tilt, reach, steep = -a * b * part, q * q * half * half, a * a * q * q * part
        lowest = -b / a * half
        x = min(max(lowest, low), high)
        down = half if x == lowest else np.sqrt(max(ZERO, (reach - steep * x * x) * part)) + tilt * x
        x = min(max(-lowest, low), high)
        up = half if x == -lowest else np.sqrt(max(ZERO, (reach - steep * x * x) * part)) - tilt * x
        slack = SLACK + SLACK * half
        first = min(max(np.floor(np.ceil(under - up - slack) * HALF), ZERO), np.float32(GROUPS))
        begins[k] = first
        ends[k] = min(max(np.floor((under + down + slack) * HALF) + ONE, first), np.float32(GROUPS))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _any_open(through):
    most = nb.carray(scratch(LANES), LANES)
    for c in range(LANES):
        most[c] = -ONE
    for g in range(GROUPS):
        for c in range(LANES):
            most[c] = most[c] if most[c] > through[g, c] else through[g, c]
    found = -ONE
    for c in range(LANES):
        found = max(found, most[c])
    return found > 0


@nb.njit(cache=True, error_model="numpy", parallel=True)
def blend(rows, starts, lists, tiles_x, limits, planes):
    """planes [BLENDED_PLANES, height, width] of one view, colour on black. `limits`: alpha_max, alpha_min, T_min."""
    height, width = planes.shape[1], planes.shape[2]
    for tile in nb.prange(len(starts) - 1):
        left, top = (tile % tiles_x) * WIDE, (tile // tiles_x) * HIGH
        _blend_tile(rows, lists[starts[tile] : starts[tile + 1]], left, top, width, height, limits, planes)


@nb.njit(cache=True, error_model="numpy", parallel=True)
def blend_backward(rows, starts, lists, bounds, tiles_x, limits, planes, given, parts):
    """parts [tasks, n, GRADIENT_COLUMNS]: gradients of projected rows from `given` = ∂loss/∂planes.

    Task t owns tiles bounds[t] to bounds[t + 1] and the slice parts[t], so nothing is shared and the sum does
    not depend on timing. Gaussians are visited front to back: what is behind one is the total minus what is in front.
    """
    height, width = planes.shape[1], planes.shape[2]
    for task in nb.prange(len(bounds) - 1):
        for tile in range(bounds[task], bounds[task + 1]):
            left, top = (tile % tiles_x) * WIDE, (tile // tiles_x) * HIGH
            members = lists[starts[tile] : starts[tile + 1]]
            _blend_tile_backward(rows, members, left, top, width, height, limits, planes, given, parts[task])
