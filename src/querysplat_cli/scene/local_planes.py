"""Planes through a map of inverse depth, each fitted to the surroundings of one pixel."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Smooth = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class LocalPlanes:
    """For each pixel of [height, width], the weighted mean of its surroundings and the slopes of the plane through it.

    A plane of space is a linear function of the pixel in inverse depth. `x` and `y` are the mean places, in pixels.
    `weight` is that of all the surroundings.
    """

    weight: np.ndarray
    x: np.ndarray
    y: np.ndarray
    mean: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray

    def at(self, x: np.ndarray, y: np.ndarray, most: float) -> np.ndarray:
        """The planes at other places, at most the share `most` of the mean away from the mean.

        They come nearer than the mean only towards the bottom of the picture, as a floor does. Elsewhere a surface that
        came nearer and nearer would stand in the open space in front of others.
        """
        down = self.slope_y * (y - self.y)
        nearer = np.clip(np.where(y > self.y, down, 0), 0, most * self.mean)
        return np.asarray(self.mean + np.clip(self.slope_x * (x - self.x) + down, -most * self.mean, nearer))


def local_planes(inverse: np.ndarray, weight: np.ndarray, smooth: Smooth, ridge: float) -> LocalPlanes:
    """Weighted least squares around every pixel of `inverse` [height, width], which is positive.

    Where no surroundings have any weight, the plane is 0.

    `smooth` spreads a map over the surroundings of each pixel. `ridge` is a length in pixels: surroundings that are
    smaller than this do not tilt a plane.
    """
    y, x = np.indices(inverse.shape, np.float32) + np.float32(0.5)
    unit = np.float32(max(inverse.shape) / 2)  # moments of pixels near 1 keep their precision
    x, y = x / unit - 1, y / unit - 1
    total = smooth(weight)
    divisor = np.maximum(total, 1e-9)

    def mean(values: np.ndarray) -> np.ndarray:
        return smooth(weight * values) / divisor

    mx, my, mz = mean(x), mean(y), mean(inverse)
    least = (ridge / unit) ** 2
    xx, yy, xy = mean(x * x) - mx * mx + least, mean(y * y) - my * my + least, mean(x * y) - mx * my
    xz, yz = mean(x * inverse) - mx * mz, mean(y * inverse) - my * mz
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
    return LocalPlanes(total, (mx + 1) * unit, (my + 1) * unit, mz, slope_x / unit, slope_y / unit)
