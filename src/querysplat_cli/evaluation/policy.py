"""Numbers that decide how scenes are scored."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationPolicy:
    """The protocols' sizes and the limits of the scores. None was tuned: the sizes are those of the authors."""

    release_input_side: int = 512
    """Side of an input square in the `release` protocol, in pixels."""
    release_target_side: int = 256
    """Side of a scored square in the `release` protocol, in pixels."""
    text_input_side: int = 256
    """Shorter side of an input in the `text` protocol, in pixels. Renders are made at the method's own size, and
    enlarged to the photo's."""
    generated_cases: int = 300
    """Cases of a generated split, as many as the authors' splits have."""
    generated_targets: int = 4
    """Interpolation targets of a generated case, and as many extrapolation targets."""
    pose_thresholds: tuple[int, ...] = (5, 15, 30)
    """Degrees at which RRA, RTA and AUC of camera poses are reported."""


EVALUATION_POLICY = EvaluationPolicy()


@dataclass(frozen=True)
class FittingPolicy:
    """How a target camera is fitted to a frozen scene. Figures are those of `benchmarks/few_views.py`; no score of an
    evaluation was tuned with them."""

    steps: int = 90
    blurs: tuple[int, ...] = (9, 5, 1)
    """Width in pixels that pictures are averaged over, in equal parts of the steps: first coarse, then sharp."""
    rate: float = 0.02
    """Adam's first rate: radians, scene depths, and the logarithm of the focal length."""
    last_rate: float = 0.05
    """Share of the rate that is left at the end."""


FITTING_POLICY = FittingPolicy()
