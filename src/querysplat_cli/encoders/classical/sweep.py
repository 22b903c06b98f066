"""Plane sweep: how well each depth of each pixel explains the neighbouring views.

Planes are fronto-parallel to the reference camera and evenly spaced in inverse depth. The match is zero-mean
normalised cross-correlation over a square window; of several sources the better half counts, because a point
hidden in one view is usually visible in another.
"""

import cv2
import numba as nb
import numpy as np

WINDOW = 5
"""Side of the correlation window in pixels."""
WORST = 127
"""Cost of no correlation at all, in the 8-bit volume; 0 is a perfect match."""
UNSEEN = 64
"""Cost where no source sees the point: neither for nor against it."""
FLAT = 2e-5
"""Variance added to both windows ([0, 1]² grey): noise in flat regions then correlates with nothing."""


def cost_volume(
    reference: np.ndarray,
    K: np.ndarray,
    sources: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    inverse_depths: np.ndarray,
) -> np.ndarray:
    """Matching costs [height, width, planes], 0 to 127.

    `reference` is grey [height, width] in [0, 1] with intrinsics `K` (pixel centres at +0.5); each source is
    (grey, K, T) with T [4, 4] from the reference camera to the source camera.
    """
    height, width = reference.shape
    mean = _box(reference)
    spread = np.maximum(_box(reference * reference) - mean * mean, 0) + FLAT
    costs = np.empty((height, width, len(inverse_depths)), np.uint8)
    warped = np.empty((len(sources), height, width), np.float32)
    means, squares, products = np.empty_like(warped), np.empty_like(warped), np.empty_like(warped)
    for plane, inverse in enumerate(inverse_depths):
        for s, (grey, source_K, transform) in enumerate(sources):
            homography = plane_homography(K, source_K, transform, inverse)
            cv2.warpPerspective(
                grey,
                homography,
                (width, height),
                dst=warped[s],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=-1.0,
            )
            cv2.boxFilter(warped[s], -1, (WINDOW, WINDOW), dst=means[s])
            cv2.sqrBoxFilter(warped[s], cv2.CV_32F, (WINDOW, WINDOW), dst=squares[s])
            cv2.boxFilter(cv2.multiply(warped[s], reference), -1, (WINDOW, WINDOW), dst=products[s])
        _correlate(mean, spread, warped, means, squares, products, costs, plane)
    return costs


def plane_homography(K: np.ndarray, source_K: np.ndarray, transform: np.ndarray, inverse_depth: float) -> np.ndarray:
    """Reference pixel → source pixel for the plane z = 1/inverse_depth, in OpenCV's integer-centre pixels."""
    to_centres = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    induced = transform[:3, :3] + inverse_depth * np.outer(transform[:3, 3], [0, 0, 1.0])
    return np.linalg.inv(to_centres) @ source_K @ induced @ np.linalg.inv(K) @ to_centres


def _box(image: np.ndarray) -> np.ndarray:
    return cv2.boxFilter(image, -1, (WINDOW, WINDOW))


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _correlate(mean, spread, warped, means, squares, products, costs, plane):
    count, height, width = warped.shape
    for y in nb.prange(height):
        for x in range(width):
            best, second, seen = np.float32(2), np.float32(2), 0
            for s in range(count):
                if warped[s, y, x] < 0:
                    continue
                seen += 1
                m = means[s, y, x]
                variance = max(squares[s, y, x] - m * m, np.float32(0)) + np.float32(FLAT)
                covariance = products[s, y, x] - m * mean[y, x]
                cost = np.float32(1) - covariance / np.sqrt(variance * spread[y, x])
                if cost < best:
                    best, second = cost, best
                elif cost < second:
                    second = cost
            if seen == 0:
                costs[y, x, plane] = UNSEEN
                continue
            # With three sources or more two must agree; a single good match is easily an accident.
            cost = (best + second) * np.float32(0.5) if seen > 2 else best
            costs[y, x, plane] = min(np.float32(WORST), cost * np.float32(WORST))
