"""Blending and its derivative, compiled.

Tiles are blended independently, one Gaussian after the other, WIDE pixels of a row at a time. The inner loops over `c`
have constant length and no branches, and become a few vector instructions.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

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
BLENDED_PLANES = 5
"""The values that are blended: red, green, blue, 1 (for alpha) and z."""
PLANE_PIXELS = BLENDED_PLANES * PIXELS
SUMS = 7
"""The sums of the backward pass over a column: −∂loss/∂σ times 1, dy, dy²; red, green, blue, z."""
COLUMN_SUMS = SUMS * WIDE

AHEAD = 4
"""Gaussians between asking for a row and using it."""
QUARTER = np.float32(0.25)
EIGHTH = np.float32(0.125)
ONE = np.float32(1)
# exp(−8s) is the 8th power of a polynomial in s, fitted on [0, 3/4]: relative error 2.5e-6 with rounding.
LIMIT = np.float32(0.75)
E0, E1, E2, E3, E4, E5 = (
    np.float32(c) for c in (0.99999988, -0.99998954, 0.49984700, -0.16582604, 0.039522059, -0.0056987114)
)


@intrinsic(prefer_literal=True)
def _scratch(typing, size):
    """`size` float32 on the stack, which LLVM can keep in registers; it cannot do that to a numpy array."""

    def generate(context, builder, signature, arguments):
        place = cgutils.alloca_once(builder, ir.FloatType(), size=ir.Constant(ir.IntType(64), size.literal_value))
        place.align = 64
        return place

    return types.CPointer(types.float32)(size), generate


@intrinsic
def _prefetch(typing, array, row):
    """Ask for a row of a 2D float32 array ahead of its use."""

    def generate(context, builder, signature, arguments):
        place = make_array(signature.args[0])(context, builder, arguments[0])
        columns = builder.extract_value(place.shape, 1)
        first = builder.gep(place.data, [builder.mul(arguments[1], columns)])
        number, byte = ir.IntType(32), ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        last = builder.gep(first, [builder.sub(columns, ir.Constant(columns.type, 1))])
        for address in (first, last):
            builder.call(fetch, [builder.bitcast(address, byte), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@nb.njit(error_model="numpy", fastmath={"contract"}, inline="always")
def _alpha(across, s, alpha_max, alpha_min):
    """α of one pixel, min(cap, exp(−across² − s)) or 0; forward and backward share it to the last bit."""
    s = min(across * across + s, LIMIT)
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
    through = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    red = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    green = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    blue = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    depth = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    start = nb.carray(_scratch(HIGH), HIGH)
    s = nb.carray(_scratch(HIGH), HIGH)
    used = min(HIGH, height - top)
    for r in range(HIGH):
        for c in range(WIDE):
            through[r, c] = ONE if left + c < width else -ONE
            red[r, c] = ZERO
            green[r, c] = ZERO
            blue[r, c] = ZERO
            depth[r, c] = ZERO
    for k in range(len(members)):
        _prefetch(rows, members[min(k + AHEAD, len(members) - 1)])
        row = rows[members[k]]
        a, b, q = QUARTER * row[A], QUARTER * row[B], QUARTER * row[C]
        offset = a * (np.float32(left) + HALF - row[X])
        lost = EIGHTH * row[LOST]
        below = np.float32(top) + HALF - row[Y]
        first, last = _rows_met(row, top, used)
        for r in range(HIGH):
            y = np.float32(r) + below
            start[r] = offset + b * y
            s[r] = (q * y) * (q * y) + lost
        for r in range(first, last):
            for c in range(WIDE):
                alpha = _alpha(start[r] + a * np.float32(c), s[r], alpha_max, alpha_min)
                t = through[r, c]
                before = max(t, ZERO)
                weight = before * alpha
                after = before - weight
                goes_on = after > least
                weight = weight if goes_on else ZERO
                through[r, c] = after if goes_on else -abs(t)
                red[r, c] += weight * row[RED]
                green[r, c] += weight * row[GREEN]
                blue[r, c] += weight * row[BLUE]
                depth[r, c] += weight * row[DEPTH]
        if k % 16 == 15 and not _any_open(through):
            break
    for r in range(used):
        for c in range(min(WIDE, width - left)):
            planes[0, top + r, left + c] = red[r, c]
            planes[1, top + r, left + c] = green[r, c]
            planes[2, top + r, left + c] = blue[r, c]
            planes[3, top + r, left + c] = ONE - abs(through[r, c])
            planes[4, top + r, left + c] = depth[r, c]


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _blend_tile_backward(rows, members, left, top, width, height, limits, planes, given, out):
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    through = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    behind = nb.carray(_scratch(PIXELS), (HIGH, WIDE))
    g = nb.carray(_scratch(PLANE_PIXELS), (BLENDED_PLANES, HIGH, WIDE))
    lanes = nb.carray(_scratch(COLUMN_SUMS), (SUMS, WIDE))
    dy = nb.carray(_scratch(HIGH), HIGH)
    start = nb.carray(_scratch(HIGH), HIGH)
    s = nb.carray(_scratch(HIGH), HIGH)
    used = min(HIGH, height - top)
    for r in range(HIGH):
        for c in range(WIDE):
            inside = r < used and left + c < width
            through[r, c] = ONE if inside else -ONE
            behind[r, c] = ZERO
            for plane in range(BLENDED_PLANES):
                g[plane, r, c] = given[plane, top + r, left + c] if inside else ZERO
                behind[r, c] += g[plane, r, c] * planes[plane, top + r, left + c] if inside else ZERO
    for k in range(len(members)):
        _prefetch(rows, members[min(k + AHEAD, len(members) - 1)])
        _prefetch(out, members[min(k + AHEAD, len(members) - 1)])
        row = rows[members[k]]
        a, b, q = QUARTER * row[A], QUARTER * row[B], QUARTER * row[C]
        offset = a * (np.float32(left) + HALF - row[X])
        lost = EIGHTH * row[LOST]
        below = np.float32(top) + HALF - row[Y]
        first, last = _rows_met(row, top, used)
        lanes[:, :] = ZERO
        for r in range(HIGH):
            y = np.float32(r) + below
            dy[r] = y
            start[r] = offset + b * y
            s[r] = (q * y) * (q * y) + lost
        for r in range(first, last):
            for c in range(WIDE):
                alpha = _alpha(start[r] + a * np.float32(c), s[r], alpha_max, alpha_min)
                t = through[r, c]
                before = max(t, ZERO)
                weight = before * alpha
                after = before - weight
                goes_on = after > least
                weight = weight if goes_on else ZERO
                alpha = alpha if goes_on else ZERO
                through[r, c] = after if goes_on else -abs(t)
                value = g[0, r, c] * row[RED] + g[1, r, c] * row[GREEN] + g[2, r, c] * row[BLUE]
                value += g[3, r, c] + g[4, r, c] * row[DEPTH]
                rest = behind[r, c] - weight * value
                behind[r, c] = rest
                # −∂loss/∂σ; none through the cap.
                slope = weight * value - rest * (alpha / (ONE - alpha))
                slope = slope if alpha < alpha_max else ZERO
                lanes[0, c] += slope
                lanes[1, c] += slope * dy[r]
                lanes[2, c] += slope * (dy[r] * dy[r])
                lanes[3, c] += weight * g[0, r, c]
                lanes[4, c] += weight * g[1, r, c]
                lanes[5, c] += weight * g[2, r, c]
                lanes[6, c] += weight * g[4, r, c]
        if first < last:
            _add_moments(lanes, np.float32(left) + HALF - row[X], row, out[members[k]])
        if k % 16 == 15 and not _any_open(through):
            break


@nb.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _add_moments(lanes, dx, row, out):
    """Add the gradient of one projected row, from the column sums of −∂loss/∂σ and of the blended values."""
    m, mx, my, mxx, mxy, myy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    red, green, blue, depth = ZERO, ZERO, ZERO, ZERO
    for c in range(WIDE):
        x = dx + np.float32(c)
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


@nb.njit(error_model="numpy", inline="always")
def _rows_met(row, top, used):
    """Rows of the tile whose pixel centres the Gaussian's extent reaches."""
    middle = row[Y] - np.float32(top) - HALF
    first = max(ZERO, np.ceil(middle - row[HALF_HEIGHT]))
    last = min(np.float32(used), np.floor(middle + row[HALF_HEIGHT]) + ONE)
    return int(first), int(last)


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _any_open(through):
    most = -ONE
    for r in range(HIGH):
        for c in range(WIDE):
            most = max(most, through[r, c])
    return most > 0


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
