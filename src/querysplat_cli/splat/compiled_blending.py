"""Tiles, their lists of Gaussians, and blending with its derivative, compiled.

A picture is cut into tiles of TILE × TILE pixels. The Gaussians, sorted by depth once, are dealt to the
tiles that their ellipse α ≥ alpha_min really touches, so every tile's list is in depth order without a sort
of its own. Tiles are blended independently, 16 pixels of a row at a time.
"""

import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_projection import (
    BLUE,
    DEPTH,
    GRADIENT_COLUMNS,
    GREEN,
    HALF_HEIGHT,
    HALF_WIDTH,
    OPACITY,
    RED,
    XX,
    XY,
    YY,
    X,
    Y,
)

TILE = 16
PIXELS = TILE * TILE
PLANES = 5
"""What is blended: red, green, blue, 1 (alpha) and z."""

HALF = np.float32(0.5)
ONE = np.float32(1)
ZERO = np.float32(0)
EIGHTH = np.float32(0.125)
SIGMA_LIMIT = np.float32(6)
# exp(−s) on [0, 6] is the 8th power of a polynomial in s/8, fitted to relative error on [0, 3/4]: 2e-6 in all,
# most of it float32 rounding, and no branches.
E0, E1, E2, E3, E4, E5, E6 = (
    np.float32(c) for c in (1.0, -0.99999958, 0.49999216, -0.16660661, 0.041443445, -0.0078977337, 0.00094978482)
)


@nb.njit(error_model="numpy", fastmath={"contract"}, inline="always")
def _alpha(xx, xy, yy, opacity, dx, dy, alpha_max, alpha_min):
    """α of one pixel; the forward and the backward pass share this function to the last bit."""
    sigma = HALF * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    s = min(max(sigma, ZERO), SIGMA_LIMIT) * EIGHTH
    e = E0 + s * (E1 + s * (E2 + s * (E3 + s * (E4 + s * (E5 + s * E6)))))
    e *= e
    e *= e
    e *= e
    alpha = min(opacity * e, alpha_max)
    return alpha if alpha >= alpha_min else ZERO


@nb.njit(cache=True, error_model="numpy", inline="always")
def _row_reach(row, ylow, yhigh, reach):
    """x-extent, relative to the centre, of the ellipse σ ≤ reach/2 between two heights above the centre."""
    xx, xy, yy = np.float64(row[XX]), np.float64(row[XY]), np.float64(row[YY])
    det = xx * yy - xy * xy
    if not det > 0:
        return -np.float64(row[HALF_WIDTH]), np.float64(row[HALF_WIDTH])
    widest = np.sqrt(reach * yy / det)
    tilt = -xy / xx  # x of the chord's middle for each unit of y
    at = -xy / yy * widest  # y at which the ellipse reaches furthest right
    y = min(max(at, ylow), yhigh)
    right = widest if y == at else tilt * y + np.sqrt(max(0.0, reach * xx - det * y * y)) / xx
    y = min(max(-at, ylow), yhigh)
    left = -widest if y == -at else tilt * y - np.sqrt(max(0.0, reach * xx - det * y * y)) / xx
    slack = 1e-3 + 1e-4 * widest
    return left - slack, right + slack


@nb.njit(cache=True, error_model="numpy", parallel=True)
def deal(rows, order, alpha_min, tiles_x, tiles_y, bands, counts, starts, lists):
    """Count (lists empty) or fill the tiles' lists. Each band of tile rows is one task, so nothing is shared."""
    filling = len(lists) > 0
    for band in nb.prange(bands):
        first, last = band * tiles_y // bands, (band + 1) * tiles_y // bands
        counts[first * tiles_x : last * tiles_x] = 0
        for k in range(len(order)):
            i = order[k]
            x, y = np.float64(rows[i, X]), np.float64(rows[i, Y])
            top, bottom = y - rows[i, HALF_HEIGHT], y + rows[i, HALF_HEIGHT]
            if bottom <= first * TILE or top >= last * TILE:
                continue
            low = max(first, int(max(top, 0.0)) // TILE)
            high = min(last - 1, int(min(bottom, last * TILE - 0.5)) // TILE)
            reach = 2 * np.log(np.float64(rows[i, OPACITY]) / alpha_min)
            for tile_y in range(low, high + 1):
                left, right = _row_reach(rows[i], tile_y * TILE + 0.5 - y, (tile_y + 1) * TILE - 0.5 - y, reach)
                left, right = x + left, x + right
                # Only pixel centres count.
                if right < 0.5 or left > tiles_x * TILE - 0.5 or left > right:
                    continue
                from_x = int(max(left - 0.5, 0.0)) // TILE
                to_x = int(min(right - 0.5, tiles_x * TILE - 1.0)) // TILE
                for tile_x in range(from_x, to_x + 1):
                    tile = tile_y * tiles_x + tile_x
                    if filling:
                        lists[starts[tile] + counts[tile]] = i
                    counts[tile] += 1


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, parallel=True)
def blend(rows, starts, lists, tiles_x, limits, planes):
    """planes [PLANES, height, width] of one view, colour on black. `limits`: alpha_max, alpha_min, T_min."""
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    height, width = planes.shape[1], planes.shape[2]
    for tile in nb.prange(len(starts) - 1):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        used = min(TILE, height - top)
        through = np.ones((TILE, TILE), np.float32)
        live = np.ones((TILE, TILE), np.float32)
        sums = np.zeros((PLANES, TILE, TILE), np.float32)
        for k in range(starts[tile], starts[tile + 1]):
            row = rows[lists[k]]
            middle_x, middle_y = row[X] - np.float32(left), row[Y] - np.float32(top)
            xx, xy, yy, opacity = row[XX], row[XY], row[YY], row[OPACITY]
            red, green, blue, z = row[RED], row[GREEN], row[BLUE], row[DEPTH]
            first = max(0, int(np.ceil(middle_y - row[HALF_HEIGHT] - HALF)))
            last = min(used, int(np.floor(middle_y + row[HALF_HEIGHT] - HALF)) + 1)
            for r in range(first, last):
                dy = np.float32(r) + HALF - middle_y
                for c in range(TILE):
                    dx = np.float32(c) + HALF - middle_x
                    alpha = _alpha(xx, xy, yy, opacity, dx, dy, alpha_max, alpha_min) * live[r, c]
                    after = through[r, c] * (ONE - alpha)
                    goes_on = after > least
                    weight = through[r, c] * alpha if goes_on else ZERO
                    live[r, c] = live[r, c] if goes_on else ZERO
                    through[r, c] = after if goes_on else through[r, c]
                    sums[0, r, c] += weight * red
                    sums[1, r, c] += weight * green
                    sums[2, r, c] += weight * blue
                    sums[4, r, c] += weight * z
            if (k - starts[tile]) % 16 == 15 and not live.any():
                break
        for r in range(used):
            for c in range(min(TILE, width - left)):
                for plane in range(3):
                    planes[plane, top + r, left + c] = sums[plane, r, c]
                planes[3, top + r, left + c] = ONE - through[r, c]
                planes[4, top + r, left + c] = sums[4, r, c]


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, parallel=True)
def blend_backward(rows, starts, lists, bounds, tiles_x, limits, planes, given, parts):
    """parts [tasks, n, GRADIENT_COLUMNS]: gradients of projected rows from `given` = ∂loss/∂planes.

    Task t owns tiles bounds[t] to bounds[t + 1] and the slice parts[t], so nothing is shared and the sum does
    not depend on timing. Front to back: what lies behind a Gaussian is the total minus what came before.
    """
    alpha_max, alpha_min, least = limits[0], limits[1], limits[2]
    height, width = planes.shape[1], planes.shape[2]
    for task in nb.prange(len(bounds) - 1):
        through = np.empty((TILE, TILE), np.float32)
        live = np.empty((TILE, TILE), np.float32)
        behind = np.empty((TILE, TILE), np.float32)
        g = np.empty((PLANES, TILE, TILE), np.float32)
        lanes = np.empty((GRADIENT_COLUMNS, TILE), np.float32)
        for tile in range(bounds[task], bounds[task + 1]):
            left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            used = min(TILE, height - top)
            through[:, :] = ONE
            live[:, :] = ZERO
            behind[:, :] = ZERO
            g[:, :, :] = ZERO
            for r in range(used):
                for c in range(min(TILE, width - left)):
                    live[r, c] = ONE
                    for plane in range(PLANES):
                        g[plane, r, c] = given[plane, top + r, left + c]
                        behind[r, c] += given[plane, top + r, left + c] * planes[plane, top + r, left + c]
            for k in range(starts[tile], starts[tile + 1]):
                i = lists[k]
                row = rows[i]
                middle_x, middle_y = row[X] - np.float32(left), row[Y] - np.float32(top)
                xx, xy, yy, opacity = row[XX], row[XY], row[YY], row[OPACITY]
                red, green, blue, z = row[RED], row[GREEN], row[BLUE], row[DEPTH]
                first = max(0, int(np.ceil(middle_y - row[HALF_HEIGHT] - HALF)))
                last = min(used, int(np.floor(middle_y + row[HALF_HEIGHT] - HALF)) + 1)
                if first >= last:
                    continue
                lanes[:, :] = ZERO
                for r in range(first, last):
                    dy = np.float32(r) + HALF - middle_y
                    for c in range(TILE):
                        dx = np.float32(c) + HALF - middle_x
                        alpha = _alpha(xx, xy, yy, opacity, dx, dy, alpha_max, alpha_min) * live[r, c]
                        after = through[r, c] * (ONE - alpha)
                        goes_on = after > least
                        alpha = alpha if goes_on else ZERO
                        live[r, c] = live[r, c] if goes_on else ZERO
                        weight = through[r, c] * alpha
                        value = g[0, r, c] * red + g[1, r, c] * green + g[2, r, c] * blue + g[3, r, c] + g[4, r, c] * z
                        rest = behind[r, c] - weight * value
                        behind[r, c] = rest
                        slope = through[r, c] * value - rest / (ONE - alpha)
                        through[r, c] = after if goes_on else through[r, c]
                        # q = −∂loss/∂σ; no gradient through the cap.
                        q = slope * alpha if alpha < alpha_max else ZERO
                        lanes[0, c] += q * dx
                        lanes[1, c] += q * dy
                        lanes[2, c] += q * dx * dx
                        lanes[3, c] += q * dx * dy
                        lanes[4, c] += q * dy * dy
                        lanes[5, c] += q
                        lanes[6, c] += weight * g[0, r, c]
                        lanes[7, c] += weight * g[1, r, c]
                        lanes[8, c] += weight * g[2, r, c]
                        lanes[9, c] += weight * g[4, r, c]
                s = np.zeros(GRADIENT_COLUMNS, np.float32)
                for column in range(GRADIENT_COLUMNS):
                    for c in range(TILE):
                        s[column] += lanes[column, c]
                out = parts[task, i]
                out[X] += xx * s[0] + xy * s[1]
                out[Y] += xy * s[0] + yy * s[1]
                out[XX] -= HALF * s[2]
                out[XY] -= s[3]
                out[YY] -= HALF * s[4]
                out[OPACITY] += s[5] / opacity
                out[RED] += s[6]
                out[GREEN] += s[7]
                out[BLUE] += s[8]
                out[DEPTH] += s[9]
                if (k - starts[tile]) % 16 == 15 and not live.any():
                    break
