"""What to optimise, for how many steps, and with how many views each."""

from dataclasses import dataclass, replace
from typing import Literal

from querysplat_cli.runtime.choices import Space
from querysplat_cli.tto.optimise import PRUNE_AFTER, TtoSettings

LEARNING_RATE = 0.02
RESUMED_LEARNING_RATE, RESUMED_WARM_UP = 0.005, 10
"""For memories that were optimised before: Adam's first steps move every number by as much, whatever its gradient,
which helps a fresh scene (held out, dtu106 gains 0.3 dB and fortress loses 0.1) but leads an optimised one uphill."""
RELEASE_STEPS, RELEASE_LEARNING_RATE = 20, 5e-3
"""The authors' release, for learned queries."""
VIEWS_PER_STEP = 3
FEW_VIEWS, PASSES = 4, 40
"""Of so few photos, an automatic plan shows each at most so many times: they are known by heart then. What lies between
them stays covered, because much of it is seen by one of them or by none; five photos of kermit already lose by that."""
STEPS = (30, 150)
"""Fewest and most steps of an automatic plan; what more of them bring on held-out photos is little."""
QUERIES = 10_000
"""With those beyond the photos' borders, about as many as leave an automatic plan forty-five steps. Photos that would
carry more are cut more coarsely: finer queries show more only after steps for which there is no time."""
MOST_STEPS = 300
"""However much time there is."""
WORK = 14.0
DECODING, SPLATTING = (0.045, 1.2e-6), (0.05, 1.55e-6)
"""An automatic plan stays within `WORK` seconds. A step takes these, and these for each Gaussian, to decode the
memories and to splat three views of 448 × 336, on the two cores that this was measured on. It counts on these
figures and never on a clock, so the same seed gives the same scene however busy the machine is."""


@dataclass(frozen=True)
class TtoRun:
    """One run of the optimiser in one space."""

    space: Literal["features", "gaussians"]
    settings: TtoSettings


def plan_tto(
    steps: int | None,
    *,
    views: int,
    gaussians: int,
    staying: int | None = None,
    space: Space = "features",
    lr: float | None = None,
    resumed: bool = False,
    seconds: float | None = None,
) -> tuple[TtoRun, ...]:
    """Runs of `steps` steps together, or of as many as usually pay (None); with `seconds`, for no longer than these,
    and None is then as many as ever pay. `staying` are those of the `gaussians` that pruning will leave."""
    splatted = gaussians if staying is None else PRUNE_AFTER * gaussians + (1 - PRUNE_AFTER) * staying
    cost = SPLATTING[0] + SPLATTING[1] * splatted
    if space != "gaussians":
        cost += DECODING[0] + DECODING[1] * gaussians
    if steps is None:
        steps = min(max(int(WORK / cost), STEPS[0]), STEPS[1]) if seconds is None else MOST_STEPS
        if views <= FEW_VIEWS and seconds is None:
            steps = min(steps, PASSES * views // min(views, VIEWS_PER_STEP))
    usual = RESUMED_LEARNING_RATE if resumed else LEARNING_RATE
    settings = TtoSettings(
        steps=steps,
        lr=usual if lr is None else lr,
        views_per_step=VIEWS_PER_STEP if views > VIEWS_PER_STEP else None,
        warm_up=RESUMED_WARM_UP if resumed else 0,
        seconds=seconds,
        keep_cover=1 < views <= FEW_VIEWS,
    )
    return _runs(space, settings)


def plan_release(
    steps: int, *, space: Space = "features", lr: float | None = None, seconds: float | None = None
) -> tuple[TtoRun, ...]:
    """As the authors' release does: every view in every step."""
    return _runs(space, TtoSettings(steps, RELEASE_LEARNING_RATE if lr is None else lr, seconds=seconds))


def _runs(space: Space, settings: TtoSettings) -> tuple[TtoRun, ...]:
    if space != "both":
        return (TtoRun(space, settings),)
    half = replace(settings, seconds=settings.seconds and settings.seconds / 2)
    first = replace(half, steps=settings.steps - settings.steps // 2)
    return TtoRun("features", first), TtoRun("gaussians", replace(half, steps=settings.steps // 2))
