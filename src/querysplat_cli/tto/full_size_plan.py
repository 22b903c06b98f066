"""The plan of an optimisation on large photos: picture sizes, steps, and how many Gaussians splitting reaches."""

import math
from dataclasses import dataclass, replace

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY, LevelPolicy
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY


@dataclass(frozen=True)
class Photos:
    """The input photos that an optimisation can use: how many, and the (height, width) of the largest in pixels.

    `working` is the longer side of the pictures that the scene was made from, and `reached` that of the largest ones
    that it was optimised on since: smaller ones would blur it, and its loss on them would not tell.
    """

    count: int
    height: int
    width: int
    working: int
    reached: int = 0

    @property
    def smallest(self) -> int:
        """The longer side that pictures have at least, in pixels."""
        return min(max(self.working, self.reached), max(self.height, self.width))

    def enlarged(self, size: int, share: float = 1.0) -> bool:
        """Whether pictures at a share of this longer side are large enough for a stage beside the working ones."""
        return share * size >= max(FULL_SIZE_POLICY.least_enlargement * self.working, self.reached)

    def pixels(self, size: int) -> float:
        """Of one photo whose longer side has `size` pixels."""
        return self.height * self.width * (size / max(self.height, self.width)) ** 2


@dataclass(frozen=True)
class TimeLimit:
    """`seconds` on a machine whose steps take `pace` times as long as the plan counts (`step_seconds`)."""

    seconds: float
    pace: float = 1.0

    @property
    def counted(self) -> float:
        """The seconds as the plan counts them."""
        return self.seconds / self.pace


@dataclass(frozen=True)
class FullSizeStage:
    """One run in Gaussian space on photos of at most `max_size` pixels, splitting until there are `gaussians`.

    halved: the share of its steps that see their photo at half of that size, too.
    """

    max_size: int
    settings: TtoSettings
    gaussians: int
    halved: float = 0.0


@dataclass(frozen=True)
class FullSizePlan:
    """Stages of a quality, coarse to fine, and the most rounds after them.

    seconds: what the stages are expected to take on two quiet cores.
    round: what each round after the stages does; they end when the loss stops falling.
    """

    stages: tuple[FullSizeStage, ...]
    seconds: float
    round: FullSizeStage | None = None
    most_rounds: int = 0
    level: FullSizeLevel = "high"


def plan_full_size(
    level: FullSizeLevel,
    photos: Photos,
    gaussians: int,
    *,
    limit: TimeLimit | None = None,
    most: int | None = None,
) -> FullSizePlan:
    """A plan for a scene of so many Gaussians, which counts costs and never looks at a clock.

    With a `limit` the stages end by the clock, after so long altogether, and there are no rounds; the level is then the
    highest one up to `level`, or up to `high` for `standard`, that has time for its Gaussians. Photos are smaller than
    the size of the level where the time is too short for them. `most` bounds what splitting reaches.
    """
    policy = FULL_SIZE_POLICY
    if limit:
        level = _level_in_time(level, photos, limit.counted)
    limits = policy.levels[level]
    largest = min(max(photos.height, photos.width), limits.size)
    megapixels = photos.count * photos.pixels(largest) / 1e6
    allowed = limit.counted if limit else limits.planned_seconds(photos.count, megapixels)
    size = _size(photos, largest, max(gaussians, limits.sure_gaussians(photos.count)), allowed)
    target = _target(photos, photos.pixels(size), gaussians, limits, allowed, most)
    halved = limits.halved if photos.enlarged(size) else 0.0
    shares = _stages(photos, size)
    most_steps = max(1, int(_most_passes(photos, size, limits) * photos.count / len(shares)))
    stages: list[FullSizeStage] = []
    expected = 0.0
    for number, (share, part) in enumerate(shares, start=1):
        more = round(gaussians * (target / gaussians) ** (number / len(shares)))
        seen = photos.pixels(size) * share**2
        cost = step_seconds(seen, more) + halved * step_seconds(seen / 4, more)
        in_time = max(1, min(int(allowed * part / cost), most_steps))
        steps = most_steps if limit else in_time
        settings = TtoSettings(
            steps,
            policy.rate(photos.count) * (policy.later_rate if stages else 1),
            views_per_step=1,
            seconds=limit.seconds * part if limit else None,
            keep_cover=1 < photos.count <= TTO_POLICY.few_views,
            densify_after=policy.splits,
            dropout=policy.dropout if in_time > policy.dropout_passes * photos.count else 0.0,
        )
        stages.append(FullSizeStage(round(size * share), settings, more, halved))
        expected += steps * cost
    if not limits.most_rounds or limit:
        return FullSizePlan(tuple(stages), limit.seconds if limit else expected, level=level)
    last = stages[-1].settings
    again = replace(last, steps=policy.round_passes * photos.count, lr=last.lr / 2)
    return FullSizePlan(tuple(stages), expected, replace(stages[-1], settings=again), limits.most_rounds, level)


def step_seconds(pixels: float, gaussians: int) -> float:
    """What the plan counts for a step that sees so many pixels, on two quiet cores."""
    alone, each_pixel, each_gaussian = FULL_SIZE_POLICY.step_seconds
    return alone + each_pixel * pixels + each_gaussian * gaussians


def _level_in_time(highest: FullSizeLevel, photos: Photos, seconds: float) -> FullSizeLevel:
    """The highest level whose Gaussians the time can show `FullSizePolicy.fewest_passes` times in each photo.

    Photos have at least the size of the level below. "high" is in question for "standard", too: the time decides.
    """
    levels = FULL_SIZE_POLICY.levels
    steps: tuple[tuple[FullSizeLevel, FullSizeLevel], ...] = (("max", "high"), ("high", "standard"))
    for level, below in steps if highest == "max" else steps[1:]:
        pixels = photos.pixels(min(max(photos.height, photos.width), levels[below].size))
        if _affordable(photos, pixels, seconds) >= levels[level].sure_gaussians(photos.count):
            return level
    return "standard"


def _target(
    photos: Photos, pixels: float, gaussians: int, limits: LevelPolicy, seconds: float, most: int | None
) -> int:
    """How many Gaussians splitting reaches, on photos of so many pixels."""
    sure = limits.sure_gaussians(photos.count)
    worth = min(limits.gaussians, photos.count * pixels / limits.pixels_each, _affordable(photos, pixels, seconds))
    target = min(max(sure, int(worth)), limits.gaussians if most is None else most)
    return max(gaussians, min(target, int(photos.count * pixels / FULL_SIZE_POLICY.least_pixels_per_gaussian)))


def _most_passes(photos: Photos, size: int, limits: LevelPolicy) -> float:
    """How often each photo is shown at most, with pictures of a longer side of `size` pixels."""
    most = min(FULL_SIZE_POLICY.most_passes, limits.passes * max(1.0, size / photos.working) ** 2)
    return float(min(most, TTO_POLICY.passes) if photos.count <= TTO_POLICY.few_views else most)


def _size(photos: Photos, largest: int, gaussians: int, seconds: float) -> int:
    """The longer side, at most `largest`, at which the time lasts for `FullSizePolicy.fewest_passes`.

    It is that of the working pictures where the photos can be hardly larger.
    """
    policy = FULL_SIZE_POLICY
    pixels = max(0.0, _longest_step(photos, seconds) - step_seconds(0.0, gaussians)) / policy.step_seconds[1]
    size = min(largest, int(largest * math.sqrt(pixels / photos.pixels(largest))))
    return size if photos.enlarged(size) else photos.smallest


def _affordable(photos: Photos, pixels: float, seconds: float) -> float:
    """The Gaussians at which the time lasts for `FullSizePolicy.fewest_passes` over photos of so many pixels."""
    return (_longest_step(photos, seconds) - step_seconds(pixels, 0)) / FULL_SIZE_POLICY.step_seconds[2]


def _longest_step(photos: Photos, seconds: float) -> float:
    return seconds / (FULL_SIZE_POLICY.fewest_passes * photos.count)


def _stages(photos: Photos, size: int) -> tuple[tuple[float, float], ...]:
    """The stages whose pictures are large enough, each with its share of the size and of the seconds."""
    *coarse, last = FULL_SIZE_POLICY.stages
    kept = [stage for stage in coarse if photos.enlarged(size, stage[0])]
    whole = sum(part for _, part in (*kept, last))
    return tuple((share, part / whole) for share, part in (*kept, last))
