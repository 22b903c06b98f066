"""The plan of an optimisation on large photos: picture sizes, steps, and how many Gaussians splitting reaches."""

import math
from dataclasses import dataclass, replace

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY


@dataclass(frozen=True)
class Photos:
    """The input photos that an optimisation can use: how many, and the (height, width) of the largest in pixels.

    `working` is the longer side of the pictures that the scene was made from.
    """

    count: int
    height: int
    width: int
    working: int


@dataclass(frozen=True)
class FullSizeStage:
    """One run in Gaussian space on photos of at most `max_size` pixels, splitting until there are `gaussians`."""

    max_size: int
    settings: TtoSettings
    gaussians: int


@dataclass(frozen=True)
class FullSizePlan:
    """Stages, coarse to fine, and the most rounds after them.

    seconds: what the stages are expected to take on two quiet cores.
    round: what each round after the stages does; they end when the loss stops falling.
    """

    stages: tuple[FullSizeStage, ...]
    seconds: float
    round: FullSizeStage | None = None
    most_rounds: int = 0


def plan_full_size(
    level: FullSizeLevel, photos: Photos, gaussians: int, *, seconds: float | None = None
) -> FullSizePlan:
    """A plan for a scene of so many Gaussians, which counts costs and never looks at a clock.

    With `seconds` the stages end by the clock, after so long altogether, and there are no rounds. Photos are then
    smaller where the plan for the size of `level` takes longer.
    """
    policy = FULL_SIZE_POLICY
    side = max(photos.height, photos.width)
    size = min(side, policy.high_size if level == "high" else policy.max_size)
    pixels = photos.height * photos.width * (size / side) ** 2
    planned = policy.seconds[0] + policy.seconds[1] * photos.count * pixels / 1e6
    if seconds is not None and seconds < planned:
        reduced = max(min(photos.working, size), round(size * math.sqrt(seconds / planned)))
        size, pixels = reduced, pixels * (reduced / size) ** 2
    largest = policy.high_gaussians if level == "high" else policy.max_gaussians
    target = max(gaussians, min(largest, int(photos.count * pixels / policy.pixels_per_gaussian)))
    planned = min(planned, policy.most_seconds) if level == "high" else planned
    most_passes = min(policy.most_passes, policy.passes * max(1.0, size / photos.working) ** 2)
    if photos.count <= TTO_POLICY.few_views:
        most_passes = min(most_passes, TTO_POLICY.passes)
    shares = _stages(photos.working, size)
    stages, expected = [], 0.0
    for number, (share, part) in enumerate(shares, start=1):
        more = round(gaussians * (target / gaussians) ** (number / len(shares)))
        cost = _step_seconds(pixels * share**2, more)
        passes = most_passes * photos.count / len(shares)
        steps = max(1, int(passes if seconds is not None else min(planned * part / cost, passes)))
        settings = TtoSettings(
            steps,
            policy.learning_rate,
            views_per_step=1,
            seconds=None if seconds is None else seconds * part,
            keep_cover=1 < photos.count <= TTO_POLICY.few_views,
            densify_after=policy.splits,
        )
        stages.append(FullSizeStage(round(size * share), settings, more))
        expected += steps * cost
    if level == "high" or seconds is not None:
        return FullSizePlan(tuple(stages), expected if seconds is None else seconds)
    last = stages[-1].settings
    again = replace(last, steps=policy.round_passes * photos.count, lr=policy.learning_rate / 2)
    return FullSizePlan(tuple(stages), expected, FullSizeStage(size, again, target), policy.most_rounds)


def _stages(working: int, size: int) -> tuple[tuple[float, float], ...]:
    """The stages whose pictures are large enough, each with its share of the size and of the seconds."""
    *coarse, last = FULL_SIZE_POLICY.stages
    kept = [stage for stage in coarse if stage[0] * size >= FULL_SIZE_POLICY.least_enlargement * working]
    whole = sum(part for _, part in (*kept, last))
    return tuple((share, part / whole) for share, part in (*kept, last))


def _step_seconds(pixels: float, gaussians: int) -> float:
    alone, each_pixel, each_gaussian = FULL_SIZE_POLICY.step_seconds
    return alone + each_pixel * pixels + each_gaussian * gaussians
