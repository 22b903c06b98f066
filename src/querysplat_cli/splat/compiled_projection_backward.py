"""The derivatives of projection.py's equations, compiled, a few Gaussians at a time on every core.

`view` and `limits` are those of compiled_projection.py. Numba's cache depends on this file only: after a change of a
function that is imported here, touch it.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_memory import scratch64
from querysplat_cli.splat.compiled_projection import (
    ALL,
    BLOCK,
    BY_X,
    BY_XX,
    BY_XY,
    BY_Y,
    BY_YY,
    DEPTH,
    DX,
    DY,
    DZ,
    FACTOR_A,
    FACTOR_B,
    FACTOR_C,
    GAUSSIANS_AT_ONCE,
    GRADIENT_COLUMNS,
    HALF_WIDTH,
    Q0,
    Q1,
    Q2,
    Q3,
    RED,
    S0,
    S1,
    S2,
    SHARED,
    VIEW_COLUMNS,
    A,
    B,
    C,
    covariance,
    fill_basis,
    fill_slopes,
    jacobian,
    load,
    product,
    rotation,
)
from querysplat_cli.splat.conventions import CLAMP_MARGIN, COLOUR_LIMIT

SUM = SHARED
"""The first of the sums of a row of gradients, among the numbers of a block."""
OF_X, OF_Y, OF_Z = range(SUM + GRADIENT_COLUMNS, SUM + GRADIENT_COLUMNS + 3)
FIELDS = OF_Z + 1
FIELD_NUMBERS, VIEW_NUMBERS = FIELDS * BLOCK, VIEW_COLUMNS * BLOCK


@nb.njit(cache=True, error_model="numpy")
def _project_chunk_backward(gaussians, view, limits, rows, given, gradients, of_view, first, last, fresh):
    """`project_view_backward` for the Gaussians from `first` to before `last`.

    A function of its own compiles faster than the body of a parallel loop.
    """
    opacities, sh = gaussians[3], gaussians[4]
    d_means, d_quats, d_scales, d_opacities, d_sh = gradients
    if fresh:
        d_means[first:last], d_quats[first:last], d_scales[first:last] = 0, 0, 0
        d_opacities[first:last], d_sh[first:last] = 0, 0
    bands, basis, slope = sh.shape[1], np.empty(16), np.empty((16, 3))
    moved = np.empty(last - first, np.int64)
    count = _moved(rows, given, first, last, moved)
    fields = nb.carray(scratch64(FIELD_NUMBERS), (FIELDS, BLOCK))
    of_lanes = nb.carray(scratch64(VIEW_NUMBERS), (VIEW_COLUMNS, BLOCK))
    of_lanes[:, :] = 0.0
    for start in range(0, count, BLOCK):
        for lane in range(BLOCK):
            i = moved[min(start + lane, count - 1)]
            load(gaussians, i, view, fields, lane)
            fields[FACTOR_A, lane], fields[FACTOR_B, lane], fields[FACTOR_C, lane] = rows[i, A], rows[i, B], rows[i, C]
            for column in range(GRADIENT_COLUMNS):
                total = 0.0
                for part in range(given.shape[0]):
                    total += np.float64(given[part, i, column])
                fields[SUM + column, lane] = total
        _pull_back(view, limits, fields, of_lanes, count - start)
        for lane in range(min(BLOCK, count - start)):
            i = moved[start + lane]
            dx, dy, dz = fields[DX, lane], fields[DY, lane], fields[DZ, lane]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            ux, uy, uz = dx / distance, dy / distance, dz / distance
            fill_basis(basis, bands, ux, uy, uz)
            fill_slopes(slope, bands, ux, uy, uz)
            tx, ty, tz = 0.0, 0.0, 0.0
            for channel in range(3):
                value = 0.5
                for band in range(bands):
                    value += basis[band] * np.float64(sh[i, band, channel])
                if value < 0 or value > COLOUR_LIMIT:
                    continue
                gradient = fields[SUM + RED + channel, lane]
                for band in range(bands):
                    coefficient = np.float64(sh[i, band, channel])
                    d_sh[i, band, channel] += gradient * basis[band]
                    tx += gradient * coefficient * slope[band, 0]
                    ty += gradient * coefficient * slope[band, 1]
                    tz += gradient * coefficient * slope[band, 2]
            along = tx * ux + ty * uy + tz * uz
            gx = fields[OF_X, lane] + (tx - along * ux) / distance
            gy = fields[OF_Y, lane] + (ty - along * uy) / distance
            gz = fields[OF_Z, lane] + (tz - along * uz) / distance
            d_means[i, 0] += gx
            d_means[i, 1] += gy
            d_means[i, 2] += gz
            of_view[9] += gx
            of_view[10] += gy
            of_view[11] += gz
            d_opacities[i] += fields[SUM + ALL, lane] / np.float64(opacities[i])
            for axis in range(3):
                d_scales[i, axis] += fields[S0 + axis, lane]
            for part in range(4):
                d_quats[i, part] += fields[Q0 + part, lane]
    for column in range(VIEW_COLUMNS):
        of_view[column] += of_lanes[column].sum()


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _moved(rows, given, first, last, moved):
    """Fill `moved` by the visible Gaussians with a gradient; how many they are."""
    count = 0
    for i in range(first, last):
        size = 0.0
        if rows[i, HALF_WIDTH] > 0:
            for part in range(given.shape[0]):
                for column in range(GRADIENT_COLUMNS):
                    size += abs(given[part, i, column])
        if size != 0:
            moved[count] = i
            count += 1
    return count


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _pull_back(view, limits, fields, of_view, count):
    """The geometry of BLOCK Gaussians backwards: a loop without branches, which becomes vectors.

    Overwrites scales and quaternions by their gradients, and fills those of the centres, OF_X to OF_Z. Adds what
    `count` Gaussians bring, or all, to `of_view` [VIEW_COLUMNS, BLOCK].
    """
    low_pass = limits[2]
    fx, fy, cx, cy, width, height = view[12], view[13], view[14], view[15], view[16], view[17]
    margin_x, margin_y = CLAMP_MARGIN * width / (2 * fx), CLAMP_MARGIN * height / (2 * fy)
    low_x, high_x = -cx / fx - margin_x, (width - cx) / fx + margin_x
    low_y, high_y = -cy / fy - margin_y, (height - cy) / fy + margin_y
    for lane in range(BLOCK):
        counted = 1.0 if lane < count else 0.0
        dx, dy, dz = fields[DX, lane], fields[DY, lane], fields[DZ, lane]
        q0, q1, q2, q3 = fields[Q0, lane], fields[Q1, lane], fields[Q2, lane], fields[Q3, lane]
        s0, s1, s2 = fields[S0, lane], fields[S1, lane], fields[S2, lane]
        # 2σ = across² + (C·dy)² with across = A·dx + B·dy.
        a, b, q, by_y = fields[FACTOR_A, lane], fields[FACTOR_B, lane], fields[FACTOR_C, lane], fields[SUM + BY_Y, lane]
        across = a * fields[SUM + BY_X, lane] + b * by_y
        gu, gv = a * across, b * across + q * q * by_y
        x = view[0] * dx + view[1] * dy + view[2] * dz
        y = view[3] * dx + view[4] * dy + view[5] * dz
        z = view[6] * dx + view[7] * dy + view[8] * dz
        length = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        q0, q1, q2, q3 = q0 / length, q1 / length, q2 / length, q3 / length
        slope_x, slope_y = min(max(x / z, low_x), high_x), min(max(y / z, low_y), high_y)
        turn = rotation(q0, q1, q2, q3)
        jx, jy = fx / z, fy / z
        slopes = jacobian(view, jx, jy, slope_x, slope_y)
        b00, b01, b02, b10, b11, b12 = slopes
        c00, c01, c02, c10, c11, c12 = product(slopes, turn)
        a00, a01, a02, a10, a11, a12 = s0 * c00, s1 * c01, s2 * c02, s0 * c10, s1 * c11, s2 * c12
        xx, xy, yy, det = covariance(a00, a01, a02, a10, a11, a12, low_pass)
        i00, i01, i11 = yy / det, -xy / det, xx / det
        # dΣ⁻¹ = −Σ⁻¹ dΣ Σ⁻¹, so the gradient of the covariance is −Σ⁻¹ G Σ⁻¹ with G symmetric.
        g00, g01 = -0.5 * fields[SUM + BY_XX, lane], -0.5 * fields[SUM + BY_XY, lane]
        g11 = -0.5 * fields[SUM + BY_YY, lane]
        t00, t01 = i00 * g00 + i01 * g01, i00 * g01 + i01 * g11
        t10, t11 = i01 * g00 + i11 * g01, i01 * g01 + i11 * g11
        h00 = -(t00 * i00 + t01 * i01)
        h01 = -(t00 * i01 + t01 * i11)
        h11 = -(t10 * i01 + t11 * i11)
        e00 = 2 * (h00 * a00 + h01 * a10)
        e01 = 2 * (h00 * a01 + h01 * a11)
        e02 = 2 * (h00 * a02 + h01 * a12)
        e10 = 2 * (h01 * a00 + h11 * a10)
        e11 = 2 * (h01 * a01 + h11 * a11)
        e12 = 2 * (h01 * a02 + h11 * a12)
        fields[S0, lane], fields[S1, lane] = e00 * c00 + e10 * c10, e01 * c01 + e11 * c11
        fields[S2, lane] = e02 * c02 + e12 * c12
        e00, e01, e02, e10, e11, e12 = e00 * s0, e01 * s1, e02 * s2, e10 * s0, e11 * s1, e12 * s2
        # Rotation of the Gaussian: axes = B·R·S.
        p00, p01, p02 = b00 * e00 + b10 * e10, b00 * e01 + b10 * e11, b00 * e02 + b10 * e12
        p10, p11, p12 = b01 * e00 + b11 * e10, b01 * e01 + b11 * e11, b01 * e02 + b11 * e12
        p20, p21, p22 = b02 * e00 + b12 * e10, b02 * e01 + b12 * e11, b02 * e02 + b12 * e12
        f0 = 2 * (q1 * (p21 - p12) + q2 * (p02 - p20) + q3 * (p10 - p01))
        f1 = 2 * (q2 * (p01 + p10) + q3 * (p02 + p20) + q0 * (p21 - p12) - 2 * q1 * (p11 + p22))
        f2 = 2 * (q1 * (p01 + p10) + q3 * (p12 + p21) + q0 * (p02 - p20) - 2 * q2 * (p00 + p22))
        f3 = 2 * (q1 * (p02 + p20) + q2 * (p12 + p21) + q0 * (p10 - p01) - 2 * q3 * (p00 + p11))
        along = f0 * q0 + f1 * q1 + f2 * q2 + f3 * q3
        fields[Q0, lane], fields[Q1, lane] = (f0 - along * q0) / length, (f1 - along * q1) / length
        fields[Q2, lane], fields[Q3, lane] = (f2 - along * q2) / length, (f3 - along * q3) / length
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = turn
        # The Jacobian: B = J·W.
        d00 = e00 * r00 + e01 * r01 + e02 * r02
        d01 = e00 * r10 + e01 * r11 + e02 * r12
        d02 = e00 * r20 + e01 * r21 + e02 * r22
        d10 = e10 * r00 + e11 * r01 + e12 * r02
        d11 = e10 * r10 + e11 * r11 + e12 * r12
        d12 = e10 * r20 + e11 * r21 + e12 * r22
        k00 = d00 * view[0] + d01 * view[1] + d02 * view[2]
        k02 = d00 * view[6] + d01 * view[7] + d02 * view[8]
        k11 = d10 * view[3] + d11 * view[4] + d12 * view[5]
        k12 = d10 * view[6] + d11 * view[7] + d12 * view[8]
        # A slope that is held at the border moves with the border.
        free_x, free_y = (x / z > low_x) & (x / z < high_x), (y / z > low_y) & (y / z < high_y)
        free02, free12 = k02 if free_x else 0.0, k12 if free_y else 0.0
        of_view[12, lane] += counted * (gu * x / z + (k00 - free02 * slope_x) / z)
        of_view[13, lane] += counted * (gv * y / z + (k11 - free12 * slope_y) / z)
        of_view[14, lane] += counted * (gu + (0.0 if free_x else k02 / z))
        of_view[15, lane] += counted * (gv + (0.0 if free_y else k12 / z))
        gx, gy, gz = gu * jx, gv * jy, fields[SUM + DEPTH, lane]
        gz -= gu * jx * x / z + gv * jy * y / z
        gz -= (k00 - k02 * slope_x) * jx / z + (k11 - k12 * slope_y) * jy / z
        gx -= free02 * jx / z
        gy -= free12 * jy / z
        gz += free02 * jx * x / (z * z) + free12 * jy * y / (z * z)
        jz0, jz1 = -jx * slope_x, -jy * slope_y
        of_view[0, lane] += counted * (gx * dx + jx * d00)
        of_view[1, lane] += counted * (gx * dy + jx * d01)
        of_view[2, lane] += counted * (gx * dz + jx * d02)
        of_view[3, lane] += counted * (gy * dx + jy * d10)
        of_view[4, lane] += counted * (gy * dy + jy * d11)
        of_view[5, lane] += counted * (gy * dz + jy * d12)
        of_view[6, lane] += counted * (gz * dx + jz0 * d00 + jz1 * d10)
        of_view[7, lane] += counted * (gz * dy + jz0 * d01 + jz1 * d11)
        of_view[8, lane] += counted * (gz * dz + jz0 * d02 + jz1 * d12)
        fields[OF_X, lane] = view[0] * gx + view[3] * gy + view[6] * gz
        fields[OF_Y, lane] = view[1] * gx + view[4] * gy + view[7] * gz
        fields[OF_Z, lane] = view[2] * gx + view[5] * gy + view[8] * gz


@nb.njit(cache=True, error_model="numpy", parallel=True)
def project_view_backward(gaussians, view, limits, rows, given, gradients, d_view, fresh):
    """Add to the five `gradients` and to `d_view` what follows from `given`, the gradient of the projected rows.

    Where `fresh`, the five gradients hold nothing yet, and the sum starts from 0.
    `given` [parts, n, GRADIENT_COLUMNS] is summed over parts. Each row of `d_view` [chunks(n), VIEW_COLUMNS] belongs to
    the Gaussians of one chunk: the gradient with respect to the rotation about the camera's centre (9 numbers), to
    minus the centre (3), and to fx, fy, cx, cy.
    """
    n = len(gaussians[0])
    for chunk in nb.prange((n + GAUSSIANS_AT_ONCE - 1) // GAUSSIANS_AT_ONCE):
        first, last = chunk * GAUSSIANS_AT_ONCE, min(n, (chunk + 1) * GAUSSIANS_AT_ONCE)
        _project_chunk_backward(gaussians, view, limits, rows, given, gradients, d_view[chunk], first, last, fresh)
