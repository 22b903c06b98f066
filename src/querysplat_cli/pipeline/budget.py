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

    def share(self, scenes: int = 1) -> "BudgetShare":
        """The time of one of `scenes` scenes; depth and queries of this one begin now."""
        return BudgetShare(self, scenes, self.elapsed())


@dataclass(frozen=True)
class BudgetShare:
    """The time of one of `scenes` scenes, whose depth and queries began after `began` seconds of the budget."""

    budget: Budget
    scenes: int
    began: float

    def optimising(self, gaussians: int) -> "OptimisingTime":
        """The time of the optimisation that begins now."""
        now = self.budget.elapsed()
        seconds, more = optimising_seconds(self.budget, now - self.began, gaussians, self.scenes)
        return OptimisingTime(self.budget, seconds, now, more or self.scenes == 1)


@dataclass(frozen=True)
class OptimisingTime:
    """`seconds` for the optimisation of one scene, which began after `began` seconds of the budget.

    for_more: whether no other scene has to be left out for lack of time.
    """

    budget: Budget
    seconds: float
    began: float
    for_more: bool

    def full_size_seconds(self) -> float | None:
        """Seconds to go on with large photos, from now; None where too few are left."""
        left = PIPELINE_POLICY.full_size_share * (self.began + self.seconds - self.budget.elapsed())
        return left if left >= PIPELINE_POLICY.least_full_size_seconds else None


def working_size(budget: Budget, photos: int, scenes: int, shape: tuple[int, int], usual: int) -> int:
    """The longer side, in pixels, of working pictures that leave time to optimise.

    `scenes` scenes are made of `photos` photos of (height, width) `shape`; `usual` is the largest side in question.
    """
    height, width = shape
    available = PIPELINE_POLICY.encoding_share * budget.left - PIPELINE_POLICY.camera_seconds * photos * scenes
    pixels = max(0.0, available) / (PIPELINE_POLICY.pixel_seconds * photos * scenes)
    size = math.sqrt(pixels * max(height, width) / min(height, width))
    return min(usual, max(PRUNE_POLICY.smallest_size, int(size)))


def optimising_seconds(budget: Budget, encoding: float, gaussians: int, scenes: int) -> tuple[float, bool]:
    """Seconds for the optimisation of this scene, and whether there is time for the rest of the `scenes`.

    `encoding` is what depth and queries of this scene took; another scene is assumed to take as long.
    """
    left = budget.left - _writing_seconds(gaussians)
    for_both = (left - (scenes - 1) * encoding) / scenes
    if scenes > 1 and for_both < PIPELINE_POLICY.optimising_share * left:
        return max(0.0, left), False
    return max(0.0, for_both), scenes > 1


def _writing_seconds(gaussians: int) -> float:
    return PIPELINE_POLICY.write_seconds + PIPELINE_POLICY.write_gaussian_seconds * gaussians
