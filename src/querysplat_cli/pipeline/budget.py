"""A time budget, and what it leaves for each stage."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.prune.policy import PRUNE_POLICY


@dataclass(frozen=True)
class Budget:
    """`seconds` for the whole command, of which `elapsed()` have passed."""

    seconds: float
    elapsed: Callable[[], float]

    @property
    def left(self) -> float:
        return self.seconds - self.elapsed()

    def optimising(self, gaussians: int) -> "OptimisingTime":
        """The time of the optimisation of so many Gaussians that begins now; the rest is for writing them."""
        return OptimisingTime(self, max(0.0, self.left - _writing_seconds(gaussians)), self.elapsed())


@dataclass(frozen=True)
class OptimisingTime:
    """`seconds` for the optimisation, which began after `began` seconds of the budget."""

    budget: Budget
    seconds: float
    began: float

    def full_size_seconds(self) -> float | None:
        """Seconds to go on with large photos, from now; None where too few are left."""
        left = PIPELINE_POLICY.full_size_share * (self.began + self.seconds - self.budget.elapsed())
        return left if left >= PIPELINE_POLICY.least_full_size_seconds else None


SIZE_STEP = 32
"""Working sizes of a budget are multiples of so many pixels. What a stopped run found is of use to the next one only
where both have the same size, and the seconds that passed before differ a little."""


def working_size(budget: Budget, photos: int, passes: int, shape: tuple[int, int], usual: int) -> int:
    """The longer side, in pixels, of working pictures that leave time to optimise.

    `passes` passes find cameras of `photos` photos of (height, width) `shape`; `usual` is the largest side in question.
    """
    height, width = shape
    available = PIPELINE_POLICY.encoding_share * budget.left - PIPELINE_POLICY.camera_seconds * photos * passes
    pixels = max(0.0, available) / (PIPELINE_POLICY.pixel_seconds * photos)
    size = math.sqrt(pixels * max(height, width) / min(height, width))
    return min(usual, max(PRUNE_POLICY.smallest_size, int(size) // SIZE_STEP * SIZE_STEP))


def _writing_seconds(gaussians: int) -> float:
    return PIPELINE_POLICY.write_seconds + PIPELINE_POLICY.write_gaussian_seconds * gaussians
