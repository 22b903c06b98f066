"""The photometric loss, its gradient and the squared error, compiled: row by row, in memory that stays in the cache.

With m the blur, SSIM = f(m(a), m(b), m(a²), m(b²), m(ab)) pixel by pixel. The blur is its own transpose, so the
gradient is m(∂f/∂m(a)) + 2a·m(∂f/∂m(a²)) + b·m(∂f/∂m(ab)).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np
from numba.core import types
from numba.extending import intrinsic

RADIUS = 5
TAPS = 2 * RADIUS + 1
C1, C2 = 0.01**2, 0.03**2
SSIM_WEIGHT = 0.2
"""Weight of (1 − SSIM)/2 beside L1 by default (paper, section 3.3)."""

ROUGH, SQUARED = range(2)
"""Columns of the sums: the loss, and the squared error of the clamped picture."""
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
F1, F2 = np.float32(C1), np.float32(C2)


@intrinsic
def _fma(typing, a, b, c):
    """a·b + c in float32, rounded once. Unlike `fastmath`, it means the same bits wherever it is inlined."""

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float32(types.float32, types.float32, types.float32), generate


@nb.njit(cache=True, error_model="numpy", parallel=True)
def photometric_sums(image, target, mask, share, ssim_weight, weights, strips, sums, gradient):
    """Fill sums [views·3·strips, 2]: a strip's part of the loss and of the squared error.

    `share` is what each pixel of a view's mask counts, `ssim_weight` what (1 − SSIM)/2 counts beside L1. gradient
    [views, 3, height, width] is that of the loss; with 0 views it is not wanted.
    """
    height = image.shape[2]
    for job in nb.prange(image.shape[0] * 3 * strips):
        view, channel, strip = job // (3 * strips), job // strips % 3, job % strips
        first, last = strip * height // strips, (strip + 1) * height // strips
        wanted = view < len(gradient)
        out = gradient[view, channel] if wanted else image[view, channel]
        _strip(
            image[view, channel],
            target[view, channel],
            mask[view],
            np.float32(share[view]),
            np.float32(0.5 * ssim_weight * share[view]),
            weights,
            first,
            last,
            wanted,
            sums[job],
            out,
        )


@nb.njit(cache=True, error_model="numpy")
def _strip(a, b, mask, share, half, weights, first, last, wanted, sums, gradient):
    """Rows `first` to `last` of one plane. `half` is what 1 − SSIM counts in each pixel."""
    height, width = a.shape
    # Rows are kept twice, TAPS apart, so that the window that ends with any row is in one piece.
    blurred = np.zeros((5, 2 * TAPS, width), np.float32)
    slopes = np.zeros((3, 2 * TAPS, width), np.float32)
    padded = np.zeros((5, width + TAPS - 1), np.float32)
    means = np.zeros((5, width), np.float32)
    by_mean = np.zeros((3, width + TAPS - 1), np.float32)
    worth = np.zeros((2, width))
    around = RADIUS if wanted else 0
    for newest in range(first - around - RADIUS, last + around + RADIUS):
        place, within = newest % TAPS, ONE if 0 <= newest < height else ZERO
        if within:
            _fill(padded, a[newest], b[newest], mask[newest])
        for plane in range(5):
            _across(padded[plane], weights, within, blurred[plane, place], blurred[plane, place + TAPS])
        y = newest - RADIUS
        if y < first - around:
            continue
        place, within = y % TAPS, ONE if 0 <= y < height else ZERO
        if within:
            for plane in range(5):
                _down(blurred[plane, (newest + 1) % TAPS :], weights, means[plane])
            _compare(means, a[y], b[y], mask[y], share, half, ONE if first <= y < last else ZERO, worth, by_mean)
        if not wanted:
            continue
        for plane in range(3):
            _across(by_mean[plane], weights, within, slopes[plane, place], slopes[plane, place + TAPS])
        if y - RADIUS >= first:
            for plane in range(3):
                _down(slopes[plane, (y + 1) % TAPS :], weights, means[plane])
            _finish(means, a[y - RADIUS], b[y - RADIUS], mask[y - RADIUS], share, gradient[y - RADIUS])
    for x in range(width):
        sums[ROUGH] += worth[ROUGH, x]
        sums[SQUARED] += worth[SQUARED, x]


@nb.njit(cache=True, error_model="numpy")
def _fill(padded, a, b, mask):
    """a, b, a², b², ab, with zeros outside of the mask and beyond the borders."""
    for x in range(len(a)):
        k = x + RADIUS
        of_a, of_b = (a[x], b[x]) if mask[x] else (ZERO, ZERO)
        padded[0, k], padded[1, k] = of_a, of_b
        padded[2, k], padded[3, k], padded[4, k] = of_a * of_a, of_b * of_b, of_a * of_b


@nb.njit(cache=True, error_model="numpy")
def _across(row, weights, within, out, again):
    """Blur a row, whose blur is zeros where it is not `within` the picture; `again` becomes a copy."""
    w0, w1, w2, w3, w4, w5 = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    for x in range(len(out)):
        total = _fma(w1, row[x + 1] + row[x + 9], w0 * (row[x] + row[x + 10]))
        total = _fma(w3, row[x + 3] + row[x + 7], _fma(w2, row[x + 2] + row[x + 8], total))
        total = within * _fma(w5, row[x + 5], _fma(w4, row[x + 4] + row[x + 6], total))
        out[x] = total
        again[x] = total


@nb.njit(cache=True, error_model="numpy")
def _down(rows, weights, out):
    """Blur the window of the first rows."""
    w0, w1, w2, w3, w4, w5 = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    for x in range(len(out)):
        total = _fma(w1, rows[1, x] + rows[9, x], w0 * (rows[0, x] + rows[10, x]))
        total = _fma(w3, rows[3, x] + rows[7, x], _fma(w2, rows[2, x] + rows[8, x], total))
        out[x] = _fma(w5, rows[5, x], _fma(w4, rows[4, x] + rows[6, x], total))


@nb.njit(cache=True, error_model="numpy")
def _compare(means, a, b, mask, share, half, counts, worth, by_mean):
    """Add the loss and the squared error of each pixel of a row that counts; fill ∂f/∂m(a), ∂f/∂m(a²), ∂f/∂m(ab)."""
    for x in range(len(a)):
        inside = ONE if mask[x] else ZERO
        mean_a, mean_b = means[0, x], means[1, x]
        raw_a, raw_b = means[2, x] - mean_a * mean_a, means[3, x] - mean_b * mean_b
        light_up = TWO * mean_a * mean_b + F1
        light_part = ONE / (mean_a * mean_a + mean_b * mean_b + F1)
        structure_up = TWO * (means[4, x] - mean_a * mean_b) + F2
        structure_part = ONE / (max(raw_a, ZERO) + max(raw_b, ZERO) + F2)
        light, structure = light_up * light_part, structure_up * structure_part
        product = light * structure
        similarity = min(max(product, -ONE), ONE)
        weight = half * inside
        error = min(max(a[x], ZERO), ONE) - b[x]
        worth[ROUGH, x] += np.float64(counts * (weight * (ONE - similarity) + share * inside * abs(a[x] - b[x])))
        worth[SQUARED, x] += np.float64(counts * (inside * error * error))
        weight = -weight if similarity == product else ZERO
        by_square = -weight * product * structure_part if raw_a >= ZERO else ZERO
        by_product = weight * light * TWO * structure_part
        of_mean = weight * structure * TWO * (mean_b - light * mean_a) * light_part
        by_mean[0, x + RADIUS] = of_mean - TWO * mean_a * by_square - mean_b * by_product
        by_mean[1, x + RADIUS], by_mean[2, x + RADIUS] = by_square, by_product


@nb.njit(cache=True, error_model="numpy")
def _finish(means, a, b, mask, share, out):
    for x in range(len(a)):
        difference = a[x] - b[x]
        sign = share if difference > ZERO else (-share if difference < ZERO else ZERO)
        slope = means[0, x] + TWO * a[x] * means[1, x] + b[x] * means[2, x] + sign
        out[x] = slope if mask[x] else ZERO
