"""How many steps, and with how many views each."""

from querysplat_cli.tto.features import TtoSettings

LEARNING_RATE = 0.02
RESUMED_LEARNING_RATE, RESUMED_WARM_UP = 0.005, 10
"""For memories that were optimised before: Adam's first steps move every number by as much, whatever its gradient,
which helps a fresh scene (held out, dtu106 gains 0.3 dB and fortress loses 0.1) but leads an optimised one uphill."""
VIEWS_PER_STEP = 3
STEPS = (40, 150)
"""Fewest and most steps of an automatic plan; what more of them bring on held-out photos is little."""
WORK = 30.0
STEP_COST, GAUSSIAN_COST = 0.047, 1.65e-6
"""An automatic plan stays within `WORK` seconds, as a step takes 0.047 s + 1.65 µs a Gaussian for three views of
448 × 336 on the two cores that this was measured on. It counts on these figures and never on a clock, so
the same seed gives the same scene however busy the machine is."""


def plan_tto(
    steps: int | None, *, views: int, gaussians: int, lr: float | None = None, resumed: bool = False
) -> TtoSettings:
    """Settings for `steps` steps, or for as many as usually pay (None)."""
    usual = RESUMED_LEARNING_RATE if resumed else LEARNING_RATE
    affordable = int(WORK / (STEP_COST + GAUSSIAN_COST * gaussians))
    return TtoSettings(
        steps=min(max(affordable, STEPS[0]), STEPS[1]) if steps is None else steps,
        lr=usual if lr is None else lr,
        views_per_step=VIEWS_PER_STEP if views > VIEWS_PER_STEP else None,
        warm_up=RESUMED_WARM_UP if resumed else 0,
    )
