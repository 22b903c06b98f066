"""The equations of projection.py, compiled, a few Gaussians at a time on every core.

Arithmetic is in float64 and relative to the camera; what is stored is float32. `view` holds the camera:
rotation world-to-camera (9 numbers), centre (3), fx, fy, cx, cy, width, height. `limits` holds near, far,
low_pass, alpha_min.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.scene.gaussians import SH_0, SH_1, SH_2, SH_3
from querysplat_cli.splat.compiled_memory import scratch64
from querysplat_cli.splat.conventions import (
    CLAMP_MARGIN,
    COLOUR_LIMIT,
    SCALE_LIMIT,
    SHORTEST_QUATERNION,
)

X, Y, A, B, C, LOST, RED, GREEN, BLUE, DEPTH, HALF_WIDTH, HALF_HEIGHT = range(12)
"""Columns of a projected row: centre and half extent in pixels (0: not visible), and the conic's factor, px⁻¹:
2σ = (A·dx + B·dy)² + (C·dy)². In this form a needle keeps its digits, which the three terms of the conic would cancel.
LOST = −ln(opacity), so that α = exp(−σ − LOST)."""
ROW_COLUMNS = 16
"""Columns of a row, of which the last ones are not used: rows are lines of the cache."""
BY_X, BY_XX, BY_XY, ALL, BY_Y, BY_YY = range(6)
"""In a row of gradients, these columns are sums over all pixels: −∂loss/∂σ times dx, dx², dx·dy, 1, dy and dy²."""
GRADIENT_COLUMNS = 10
"""The columns of a row of gradients that are used: those sums, RED, GREEN, BLUE and DEPTH."""
VIEW_COLUMNS = 16
GAUSSIANS_AT_ONCE = 512
"""Gaussians of one task. Each task has its own row of camera gradients."""
BLOCK = 16
"""Gaussians whose geometry is computed at once."""
DX, DY, DZ, Q0, Q1, Q2, Q3, S0, S1, S2, FACTOR_A, FACTOR_B, FACTOR_C = range(13)
"""Numbers of each Gaussian of a block, forward and backward: the centre from the camera's, the quaternion, the scales,
and A, B and C."""
SHARED = FACTOR_C + 1
FAINT, SEEN, U, V, Z, WIDTH, HEIGHT = range(SHARED, SHARED + 7)
"""Further numbers forward: what else the row holds, and 1 where the Gaussian is visible. The centre becomes the
direction to it."""
FIELDS = HEIGHT + 1
FIELD_NUMBERS = FIELDS * BLOCK
DIGITS, MASK = 2048, np.uint32(2047)
INFINITY = np.uint32(0x7F800000)
"""The bits of ∞ in float32."""

A20, A21, A22, A23, A24 = SH_2
A30, A31, A32, A33, A34, A35, A36 = SH_3


@nb.njit(cache=True, error_model="numpy", inline="always")
def rotation(w, x, y, z):
    """The nine entries of a unit quaternion's matrix, row by row."""
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@nb.njit(cache=True, error_model="numpy")
def fill_basis(basis, bands, x, y, z):
    """basis[:bands] of a unit direction, as in projection.py."""
    basis[0] = SH_0
    if bands > 1:
        basis[1], basis[2], basis[3] = -SH_1 * y, SH_1 * z, -SH_1 * x
    if bands > 4:
        basis[4], basis[5], basis[7] = A20 * x * y, A21 * y * z, A23 * x * z
        basis[6], basis[8] = A22 * (2 * z * z - x * x - y * y), A24 * (x * x - y * y)
    if bands > 9:
        basis[9], basis[10] = A30 * y * (3 * x * x - y * y), A31 * x * y * z
        basis[11], basis[12] = A32 * y * (4 * z * z - x * x - y * y), A33 * z * (2 * z * z - 3 * x * x - 3 * y * y)
        basis[13], basis[14] = A34 * x * (4 * z * z - x * x - y * y), A35 * z * (x * x - y * y)
        basis[15] = A36 * x * (x * x - 3 * y * y)


@nb.njit(cache=True, error_model="numpy")
def fill_slopes(slope, bands, x, y, z):
    """slope[band, axis] = ∂basis/∂direction."""
    slope[:, :] = 0.0
    if bands > 1:
        slope[1, 1], slope[2, 2], slope[3, 0] = -SH_1, SH_1, -SH_1
    if bands > 4:
        slope[4, 0], slope[4, 1] = A20 * y, A20 * x
        slope[5, 1], slope[5, 2] = A21 * z, A21 * y
        slope[6, 0], slope[6, 1], slope[6, 2] = -2 * A22 * x, -2 * A22 * y, 4 * A22 * z
        slope[7, 0], slope[7, 2] = A23 * z, A23 * x
        slope[8, 0], slope[8, 1] = 2 * A24 * x, -2 * A24 * y
    if bands > 9:
        slope[9, 0], slope[9, 1] = A30 * 6 * x * y, A30 * 3 * (x * x - y * y)
        slope[10, 0], slope[10, 1], slope[10, 2] = A31 * y * z, A31 * x * z, A31 * x * y
        slope[11, 0], slope[11, 2] = -2 * A32 * x * y, 8 * A32 * y * z
        slope[11, 1] = A32 * (4 * z * z - x * x - 3 * y * y)
        slope[12, 0], slope[12, 1] = -6 * A33 * x * z, -6 * A33 * y * z
        slope[12, 2] = A33 * (6 * z * z - 3 * x * x - 3 * y * y)
        slope[13, 0] = A34 * (4 * z * z - 3 * x * x - y * y)
        slope[13, 1], slope[13, 2] = -2 * A34 * x * y, 8 * A34 * x * z
        slope[14, 0], slope[14, 1], slope[14, 2] = 2 * A35 * x * z, -2 * A35 * y * z, A35 * (x * x - y * y)
        slope[15, 0], slope[15, 1] = A36 * 3 * (x * x - y * y), -6 * A36 * x * y


@nb.njit(cache=True, error_model="numpy", inline="always")
def jacobian(view, jx, jy, slope_x, slope_y):
    """The 2 × 3 derivatives of a pixel by the place in the world, row by row."""
    return (
        jx * (view[0] - slope_x * view[6]),
        jx * (view[1] - slope_x * view[7]),
        jx * (view[2] - slope_x * view[8]),
        jy * (view[3] - slope_y * view[6]),
        jy * (view[4] - slope_y * view[7]),
        jy * (view[5] - slope_y * view[8]),
    )


@nb.njit(cache=True, error_model="numpy", inline="always")
def product(rows, matrix):
    """A 2 × 3 matrix times a 3 × 3 one, both row by row."""
    b00, b01, b02, b10, b11, b12 = rows
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = matrix
    return (
        b00 * r00 + b01 * r10 + b02 * r20,
        b00 * r01 + b01 * r11 + b02 * r21,
        b00 * r02 + b01 * r12 + b02 * r22,
        b10 * r00 + b11 * r10 + b12 * r20,
        b10 * r01 + b11 * r11 + b12 * r21,
        b10 * r02 + b11 * r12 + b12 * r22,
    )


@nb.njit(cache=True, error_model="numpy", inline="always")
def covariance(a00, a01, a02, a10, a11, a12, low_pass):
    """xx, xy and yy of A·Aᵀ with `low_pass` added to its diagonal, and the determinant without cancellation."""
    xx = a00 * a00 + a01 * a01 + a02 * a02 + low_pass
    yy = a10 * a10 + a11 * a11 + a12 * a12 + low_pass
    xy = a00 * a10 + a01 * a11 + a02 * a12
    m0, m1, m2 = a01 * a12 - a02 * a11, a02 * a10 - a00 * a12, a00 * a11 - a01 * a10
    return xx, xy, yy, m0 * m0 + m1 * m1 + m2 * m2 + low_pass * (xx + yy - low_pass)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def load(gaussians, i, view, fields, lane):
    """Put the centre of Gaussian i from the camera's, its quaternion and its scales into one lane of the fields."""
    means, quats, scales, _, _ = gaussians
    for axis in range(3):
        fields[DX + axis, lane] = np.float64(means[i, axis]) - view[9 + axis]
        fields[S0 + axis, lane] = np.float64(scales[i, axis])
    for part in range(4):
        fields[Q0 + part, lane] = np.float64(quats[i, part])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _project_block(view, limits, fields):
    """The geometry of BLOCK Gaussians at once: a loop without branches, which becomes vectors."""
    near, far, low_pass, alpha_min = limits[0], limits[1], limits[2], limits[3]
    fx, fy, cx, cy, width, height = view[12], view[13], view[14], view[15], view[16], view[17]
    margin_x, margin_y = CLAMP_MARGIN * width / (2 * fx), CLAMP_MARGIN * height / (2 * fy)
    bright = -2 * np.log(alpha_min)
    for lane in range(BLOCK):
        dx, dy, dz = fields[DX, lane], fields[DY, lane], fields[DZ, lane]
        q0, q1, q2, q3 = fields[Q0, lane], fields[Q1, lane], fields[Q2, lane], fields[Q3, lane]
        s0, s1, s2 = fields[S0, lane], fields[S1, lane], fields[S2, lane]
        x = view[0] * dx + view[1] * dy + view[2] * dz
        y = view[3] * dx + view[4] * dy + view[5] * dz
        z = view[6] * dx + view[7] * dy + view[8] * dz
        length = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        slope_x = min(max(x / z, -cx / fx - margin_x), (width - cx) / fx + margin_x)
        slope_y = min(max(y / z, -cy / fy - margin_y), (height - cy) / fy + margin_y)
        turn = rotation(q0 / length, q1 / length, q2 / length, q3 / length)
        slopes = jacobian(view, fx / z, fy / z, slope_x, slope_y)
        c00, c01, c02, c10, c11, c12 = product(slopes, turn)
        xx, xy, yy, det = covariance(s0 * c00, s1 * c01, s2 * c02, s0 * c10, s1 * c11, s2 * c12, low_pass)
        u, v = fx * x / z + cx, fy * y / z + cy
        reach = bright - 2 * fields[FAINT, lane]  # σ ≤ reach/2 wherever α ≥ alpha_min
        half_width, half_height = np.sqrt(max(reach, 0.0) * xx), np.sqrt(max(reach, 0.0) * yy)
        in_range = (z >= near) & (z <= far) & (reach >= 0) & (length >= SHORTEST_QUATERNION)
        sized = (min(min(s0, s1), s2) > 0) & (max(max(s0, s1), s2) < SCALE_LIMIT)
        across = (u + half_width > 0) & (u - half_width < width)
        seen = in_range & sized & across & (v + half_height > 0) & (v - half_height < height)
        fields[SEEN, lane] = 1.0 if seen else 0.0
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        fields[DX, lane], fields[DY, lane], fields[DZ, lane] = dx / distance, dy / distance, dz / distance
        fields[U, lane], fields[V, lane], fields[Z, lane] = u, v, z
        fields[FACTOR_A, lane], fields[FACTOR_B, lane] = np.sqrt(yy / det), -xy / np.sqrt(yy * det)
        fields[FACTOR_C, lane] = 1 / np.sqrt(yy)
        # Slightly more than float32 rounding, so that the extent never cuts off a pixel that the threshold keeps.
        fields[WIDTH, lane], fields[HEIGHT, lane] = half_width * 1.0001 + 1e-3, half_height * 1.0001 + 1e-3


@nb.njit(cache=True, error_model="numpy")
def _project_chunk(gaussians, view, limits, rows, depths, first, last):
    opacities, sh, alpha_min = gaussians[3], gaussians[4], limits[3]
    bands, basis = sh.shape[1], np.empty(16)
    fields = nb.carray(scratch64(FIELD_NUMBERS), (FIELDS, BLOCK))
    for start in range(first, last, BLOCK):
        for lane in range(BLOCK):
            i = min(start + lane, last - 1)
            load(gaussians, i, view, fields, lane)
            opacity = np.float64(opacities[i])
            fields[FAINT, lane] = -np.log(opacity) if opacity >= alpha_min else np.inf
        _project_block(view, limits, fields)
        for lane in range(min(BLOCK, last - start)):
            i = start + lane
            rows[i, HALF_WIDTH], depths[i] = np.float32(0), np.inf
            if fields[SEEN, lane] == 0:
                continue
            fill_basis(basis, bands, fields[DX, lane], fields[DY, lane], fields[DZ, lane])
            for channel in range(3):
                value = 0.5
                for band in range(bands):
                    value += basis[band] * np.float64(sh[i, band, channel])
                rows[i, RED + channel] = min(max(value, 0.0), COLOUR_LIMIT)
            rows[i, X], rows[i, Y], rows[i, DEPTH], depths[i] = (
                fields[U, lane],
                fields[V, lane],
                fields[Z, lane],
                fields[Z, lane],
            )
            rows[i, A], rows[i, B], rows[i, C] = fields[FACTOR_A, lane], fields[FACTOR_B, lane], fields[FACTOR_C, lane]
            rows[i, LOST] = fields[FAINT, lane]
            rows[i, HALF_WIDTH], rows[i, HALF_HEIGHT] = fields[WIDTH, lane], fields[HEIGHT, lane]


@nb.njit(cache=True, error_model="numpy", parallel=True)
def project_view(gaussians, view, limits, rows, depths):
    """Fill rows [n, ROW_COLUMNS] for one view, and depths [n]: ∞ for what is not visible.

    `gaussians` are means, quats, scales, opacities and sh.
    """
    n = len(depths)
    for chunk in nb.prange((n + GAUSSIANS_AT_ONCE - 1) // GAUSSIANS_AT_ONCE):
        first, last = chunk * GAUSSIANS_AT_ONCE, min(n, (chunk + 1) * GAUSSIANS_AT_ONCE)
        _project_chunk(gaussians, view, limits, rows, depths, first, last)


@nb.njit(cache=True, error_model="numpy")
def by_depth(bits):
    """Numbers of the visible Gaussians, nearest first, equal depths in their given order.

    `bits` are the depths as unsigned integers, which sort like the positive floats that they are: a radix
    sort of three passes, each of which leaves alone the order of equals.
    """
    counts = np.zeros((3, DIGITS), np.int64)
    visible = 0
    for i in range(len(bits)):
        if bits[i] != INFINITY:
            visible += 1
            for digit in range(3):
                counts[digit, (bits[i] >> np.uint32(11 * digit)) & MASK] += 1
    order, spare = np.empty(visible, np.int32), np.empty(visible, np.int32)
    for digit in range(3):
        start = 0
        for value in range(DIGITS):
            count = counts[digit, value]
            counts[digit, value] = start
            start += count
        for k in range(len(bits) if digit == 0 else visible):
            i = k if digit == 0 else spare[k]
            if bits[i] != INFINITY:
                value = (bits[i] >> np.uint32(11 * digit)) & MASK
                order[counts[digit, value]] = i
                counts[digit, value] += 1
        order, spare = spare, order
    return spare
