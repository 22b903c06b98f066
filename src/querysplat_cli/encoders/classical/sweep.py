"""Plane sweep: how well each depth of each pixel explains the neighbouring views.

Planes are fronto-parallel to the reference camera and evenly spaced in inverse depth. The match is zero-mean
normalised cross-correlation over a square window. Of several sources the best two count: a point that is hidden in
one view is usually visible in another, and a single good match is easily an accident.
"""

import numba as nb
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY

WORST_COST = 127
"""Cost of no correlation at all, in the 8-bit volume; 0 is a perfect match."""
# Plain numbers, since a compiled kernel cannot read a dataclass.
_SWEEP_REACH = DEPTH_POLICY.sweep_reach
_UNSEEN_COST = DEPTH_POLICY.unseen_cost
_CORRELATION_FLOOR = DEPTH_POLICY.correlation_floor


def cost_volume(
    reference: np.ndarray,
    K: np.ndarray,
    sources: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    inverse_depths: np.ndarray,
) -> np.ndarray:
    """Matching costs [height, width, planes], 0 to 127, in 8 bits.

    `reference` is grey [height, width] in [0, 1], negative where there is no picture, with intrinsics `K` [3, 3]
    (pixel centres at +0.5). Each source is (grey, K, T) with T [4, 4] from the reference camera to its own.
    `inverse_depths` are those of the planes, in 1 / scene units.
    """
    homographies = np.array(
        [[plane_homography(K, source_K, T, inverse) for _, source_K, T in sources] for inverse in inverse_depths],
        np.float32,
    )
    costs = np.empty((len(inverse_depths), *reference.shape), np.uint8)
    _sweep(reference, np.stack([grey for grey, _, _ in sources]), homographies, costs)
    return np.ascontiguousarray(costs.transpose(1, 2, 0))


def plane_homography(K: np.ndarray, source_K: np.ndarray, transform: np.ndarray, inverse_depth: float) -> np.ndarray:
    """The homography [3, 3] from reference to source pixels for the plane z = 1 / inverse_depth, up to a factor > 0."""
    induced = transform[:3, :3] + inverse_depth * np.outer(transform[:3, 3], [0, 0, 1.0])
    return np.asarray(source_K @ induced @ np.linalg.inv(K))


@nb.njit(cache=True, error_model="numpy", parallel=True, fastmath=True)
def _sweep(reference, pictures, homographies, costs):
    planes, count = homographies.shape[:2]
    height, width = reference.shape
    weight = np.float32(1) / np.float32((2 * _SWEEP_REACH + 1) ** 2)
    mean, square, scratch = np.empty_like(reference), np.empty_like(reference), np.empty_like(reference)
    outside = np.empty_like(reference)
    _box_of_holes(reference, outside, mean, scratch)
    _box(reference, mean, scratch)
    _box(reference * reference, square, scratch)
    for plane in nb.prange(planes):
        warped, product = np.empty_like(reference), np.empty_like(reference)
        sums, squares, products = np.empty_like(reference), np.empty_like(reference), np.empty_like(reference)
        rows, holes = np.empty_like(reference), np.empty_like(reference)
        best, second = np.full_like(reference, _UNSEEN_COST), np.full_like(reference, _UNSEEN_COST)
        for s in range(count):
            _warp(pictures[s], homographies[plane, s], warped)
            _box_of_holes(warped, holes, product, rows)
            _box(warped, sums, rows)
            for y in range(height):
                for x in range(width):
                    product[y, x] = warped[y, x] * reference[y, x]
            _box(product, products, rows)
            for y in range(height):
                for x in range(width):
                    product[y, x] = warped[y, x] * warped[y, x]
            _box(product, squares, rows)
            for y in range(height):
                for x in range(width):
                    if holes[y, x] + outside[y, x] > 0:
                        continue
                    m, here = sums[y, x] * weight, mean[y, x] * weight
                    variance = max(squares[y, x] * weight - m * m, np.float32(0)) + np.float32(_CORRELATION_FLOOR)
                    spread = max(square[y, x] * weight - here * here, np.float32(0)) + np.float32(_CORRELATION_FLOOR)
                    cost = np.float32(1) - (products[y, x] * weight - m * here) / np.sqrt(variance * spread)
                    if count == 1:
                        best[y, x] = second[y, x] = cost
                    elif cost < best[y, x]:
                        second[y, x] = best[y, x]
                        best[y, x] = cost
                    elif cost < second[y, x]:
                        second[y, x] = cost
        for y in range(height):
            for x in range(width):
                cost = min(best[y, x] + second[y, x], np.float32(2)) * np.float32(0.5 * WORST_COST)
                costs[plane, y, x] = np.uint8(max(cost, np.float32(0)))


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _warp(picture, homography, warped):
    """Fill `warped` with bilinear samples of `picture` at the mapped pixel centres; −1 where there is none."""
    height, width = picture.shape
    h = homography
    for y in range(warped.shape[0]):
        for x in range(warped.shape[1]):
            px, py = np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)
            z = h[2, 0] * px + h[2, 1] * py + h[2, 2]
            warped[y, x] = -1
            if z <= np.float32(1e-6):
                continue
            u = (h[0, 0] * px + h[0, 1] * py + h[0, 2]) / z - np.float32(0.5)
            v = (h[1, 0] * px + h[1, 1] * py + h[1, 2]) / z - np.float32(0.5)
            if not (np.float32(0) <= u < width - 1 and np.float32(0) <= v < height - 1):
                continue
            i, j = int(u), int(v)
            a, b, c, d = picture[j, i], picture[j, i + 1], picture[j + 1, i], picture[j + 1, i + 1]
            if min(min(a, b), min(c, d)) < 0:
                continue
            fx, fy = u - i, v - j
            top, low = a + fx * (b - a), c + fx * (d - c)
            warped[y, x] = top + fy * (low - top)


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _box_of_holes(image, counts, marks, rows):
    """Fill `counts` with the number of pixels in the window around each pixel that have no picture; the others are
    scratch."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            marks[y, x] = np.float32(1) if image[y, x] < 0 else np.float32(0)
    _box(marks, counts, rows)


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _box(image, sums, rows):
    """Fill `sums` with sums over the window around each pixel, the border repeated; `rows` is scratch."""
    height, width = image.shape
    for y in range(height):
        total = np.float32(0)
        for x in range(-_SWEEP_REACH, _SWEEP_REACH + 1):
            total += image[y, min(max(x, 0), width - 1)]
        rows[y, 0] = total
        for x in range(1, width):
            total += image[y, min(x + _SWEEP_REACH, width - 1)] - image[y, max(x - _SWEEP_REACH - 1, 0)]
            rows[y, x] = total
    for y in range(height):
        for x in range(width):
            sums[y, x] = 0
        for dy in range(-_SWEEP_REACH, _SWEEP_REACH + 1):
            there = min(max(y + dy, 0), height - 1)
            for x in range(width):
                sums[y, x] += rows[there, x]
