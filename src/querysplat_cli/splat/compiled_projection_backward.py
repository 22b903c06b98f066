"""The derivatives of projection.py's equations, compiled, one Gaussian at a time on every core.

`view` and `limits` are those of compiled_projection.py. Numba's cache depends on this file only: after a change of a
function that is imported here, touch it.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_projection import (
    ALL,
    BY_X,
    BY_XX,
    BY_XY,
    BY_Y,
    BY_YY,
    DEPTH,
    GAUSSIANS_AT_ONCE,
    GRADIENT_COLUMNS,
    HALF_WIDTH,
    RED,
    A,
    B,
    C,
    covariance,
    fill_basis,
    fill_slopes,
    jacobian,
    product,
    rotation,
)
from querysplat_cli.splat.conventions import CLAMP_MARGIN, COLOUR_LIMIT


@nb.njit(cache=True, error_model="numpy")
def _project_chunk_backward(gaussians, view, limits, rows, given, gradients, of_view, first, last, fresh):
    """`project_view_backward` for the Gaussians from `first` to before `last`.

    A function of its own compiles faster than the body of a parallel loop.
    """
    means, quats, scales, opacities, sh = gaussians
    d_means, d_quats, d_scales, d_opacities, d_sh = gradients
    if fresh:
        d_means[first:last], d_quats[first:last], d_scales[first:last] = 0, 0, 0
        d_opacities[first:last], d_sh[first:last] = 0, 0
    bands = sh.shape[1]
    low_pass = limits[2]
    fx, fy, cx, cy, width, height = view[12], view[13], view[14], view[15], view[16], view[17]
    margin_x, margin_y = CLAMP_MARGIN * width / (2 * fx), CLAMP_MARGIN * height / (2 * fy)
    basis = np.empty(16)
    slope = np.empty((16, 3))
    g = np.empty(GRADIENT_COLUMNS)
    for i in range(first, last):
        if rows[i, HALF_WIDTH] == 0:
            continue
        size = 0.0
        for column in range(GRADIENT_COLUMNS):
            total = 0.0
            for part in range(given.shape[0]):
                total += np.float64(given[part, i, column])
            g[column] = total
            size += abs(total)
        if size == 0:
            continue
        # 2σ = across² + (C·dy)² with across = A·dx + B·dy.
        a, b = np.float64(rows[i, A]), np.float64(rows[i, B])
        across = a * g[BY_X] + b * g[BY_Y]
        gu, gv = a * across, b * across + np.float64(rows[i, C]) ** 2 * g[BY_Y]
        dx = np.float64(means[i, 0]) - view[9]
        dy = np.float64(means[i, 1]) - view[10]
        dz = np.float64(means[i, 2]) - view[11]
        x = view[0] * dx + view[1] * dy + view[2] * dz
        y = view[3] * dx + view[4] * dy + view[5] * dz
        z = view[6] * dx + view[7] * dy + view[8] * dz
        q0, q1 = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        q2, q3 = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        length = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        q0, q1, q2, q3 = q0 / length, q1 / length, q2 / length, q3 / length
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        low_x, high_x = -cx / fx - margin_x, (width - cx) / fx + margin_x
        low_y, high_y = -cy / fy - margin_y, (height - cy) / fy + margin_y
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
        g00, g01, g11 = -0.5 * g[BY_XX], -0.5 * g[BY_XY], -0.5 * g[BY_YY]
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
        d_scales[i, 0] += e00 * c00 + e10 * c10
        d_scales[i, 1] += e01 * c01 + e11 * c11
        d_scales[i, 2] += e02 * c02 + e12 * c12
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
        d_quats[i, 0] += (f0 - along * q0) / length
        d_quats[i, 1] += (f1 - along * q1) / length
        d_quats[i, 2] += (f2 - along * q2) / length
        d_quats[i, 3] += (f3 - along * q3) / length
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
        lens_x, lens_y = k00 / z, k11 / z
        middle_x, middle_y = k02 / z, k12 / z
        if low_x < x / z < high_x:
            lens_x, middle_x = lens_x - middle_x * slope_x, 0.0
        if low_y < y / z < high_y:
            lens_y, middle_y = lens_y - middle_y * slope_y, 0.0
        of_view[12] += gu * x / z + lens_x
        of_view[13] += gv * y / z + lens_y
        of_view[14] += gu + middle_x
        of_view[15] += gv + middle_y
        gx, gy, gz = gu * jx, gv * jy, g[DEPTH]
        gz -= gu * jx * x / z + gv * jy * y / z
        gz -= (k00 - k02 * slope_x) * jx / z + (k11 - k12 * slope_y) * jy / z
        if low_x < x / z < high_x:
            gx -= k02 * jx / z
            gz += k02 * jx * x / (z * z)
        if low_y < y / z < high_y:
            gy -= k12 * jy / z
            gz += k12 * jy * y / (z * z)
        jz0, jz1 = -jx * slope_x, -jy * slope_y
        of_view[0] += gx * dx + jx * d00
        of_view[1] += gx * dy + jx * d01
        of_view[2] += gx * dz + jx * d02
        of_view[3] += gy * dx + jy * d10
        of_view[4] += gy * dy + jy * d11
        of_view[5] += gy * dz + jy * d12
        of_view[6] += gz * dx + jz0 * d00 + jz1 * d10
        of_view[7] += gz * dy + jz0 * d01 + jz1 * d11
        of_view[8] += gz * dz + jz0 * d02 + jz1 * d12
        gwx = view[0] * gx + view[3] * gy + view[6] * gz
        gwy = view[1] * gx + view[4] * gy + view[7] * gz
        gwz = view[2] * gx + view[5] * gy + view[8] * gz
        d_opacities[i] += g[ALL] / np.float64(opacities[i])
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
            gradient = g[RED + channel]
            for band in range(bands):
                coefficient = np.float64(sh[i, band, channel])
                d_sh[i, band, channel] += gradient * basis[band]
                tx += gradient * coefficient * slope[band, 0]
                ty += gradient * coefficient * slope[band, 1]
                tz += gradient * coefficient * slope[band, 2]
        along = tx * ux + ty * uy + tz * uz
        gwx += (tx - along * ux) / distance
        gwy += (ty - along * uy) / distance
        gwz += (tz - along * uz) / distance
        d_means[i, 0] += gwx
        d_means[i, 1] += gwy
        d_means[i, 2] += gwz
        of_view[9] += gwx
        of_view[10] += gwy
        of_view[11] += gwz


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
