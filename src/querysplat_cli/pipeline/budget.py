"""A time budget: what it leaves for each stage."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from querysplat_cli.prune.resolution import SMALLEST

CAMERA_SECONDS = 0.2
"""Of structure from motion, for each photo of a pass."""
PIXEL_SECONDS = 8e-6
"""Of depth and queries, for each pixel of each view. Both were measured on two cores; on another machine they only set
how the time is shared, since optimisation lasts for as long as is left."""
WRITE_SECONDS, WRITE_GAUSSIAN_SECONDS = 1.5, 4e-6
"""Of scoring, previews and files, and for each Gaussian."""
ENCODING_SHARE = 0.4
"""The part of the time that cameras, depth and queries should take at most; pictures are made smaller for it."""
OPTIMISING_SHARE = 0.3
"""The part of the time left that optimisation must get before a second scene is made, only to be scored."""


@dataclass(frozen=True)
class Budget:
    """`seconds` for everything; `elapsed()` says how many are gone."""

    seconds: float
    elapsed: Callable[[], float]

    @property
    def left(self) -> float:
        return self.seconds - self.elapsed()


def working_size(budget: Budget, photos: int, scenes: int, shape: tuple[int, int], usual: int) -> int:
    """Longer side, in pixels, at which `scenes` scenes of photos of (height, width) `shape` leave time to optimise."""
    height, width = shape
    available = ENCODING_SHARE * budget.left - CAMERA_SECONDS * photos * scenes
    pixels = max(0.0, available) / (PIXEL_SECONDS * photos * scenes)
    size = math.sqrt(pixels * max(height, width) / min(height, width))
    return min(usual, max(SMALLEST, int(size)))


def optimising_seconds(budget: Budget, encoding: float, gaussians: int, scenes: int) -> tuple[float, bool]:
    """Seconds for the optimisation of this scene, and whether there is time for the rest of the `scenes`.

    `encoding` is what depth and queries of this one took, and those of another will.
    """
    writing = WRITE_SECONDS + WRITE_GAUSSIAN_SECONDS * gaussians
    left = budget.left - writing
    for_both = (left - (scenes - 1) * encoding) / scenes
    if scenes > 1 and for_both < OPTIMISING_SHARE * left:
        return max(0.0, left), False
    return max(0.0, for_both), scenes > 1
