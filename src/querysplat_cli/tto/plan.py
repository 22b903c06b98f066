"""How many steps, and with how many views each."""

from querysplat_cli.tto.features import TtoSettings

AUTO_STEPS = 120
LEARNING_RATE = 0.01
VIEWS_PER_STEP = 3


def plan_tto(steps: int | None, *, views: int, lr: float | None = None) -> TtoSettings:
    """Settings for `steps` steps, or for as many as usually pay (None)."""
    return TtoSettings(
        steps=AUTO_STEPS if steps is None else steps,
        lr=LEARNING_RATE if lr is None else lr,
        views_per_step=VIEWS_PER_STEP if views > VIEWS_PER_STEP else None,
    )
