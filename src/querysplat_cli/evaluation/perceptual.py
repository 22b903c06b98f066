"""FLIP and SSIMULACRA2, from the packages `flip-evaluator` and `ssimulacra2` (`pip install 'querysplat[metrics]'`)."""

import io
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.choices import FurtherMetric
from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.optional_parts import OPTIONAL_PARTS
from querysplat_cli.scene.pictures import eight_bit

Metric = Callable[[Tensor, Tensor], float]
PARTS = {"flip": "flip-evaluator", "ssimulacra2": "ssimulacra2"}
"""The package of each metric."""


def check_installed(metric: FurtherMetric) -> None:
    """Raises MissingPart where the metric's package is not installed."""
    (part,) = (part for part in OPTIONAL_PARTS if part.package == PARTS[metric])
    if find_spec(part.module) is None:
        raise MissingPart(f"--metrics {metric}: the package {part.package} is not installed", part.command)


@cache
def further_metric(name: FurtherMetric) -> Metric:
    """The function (picture, truth) of colours in [0, 1]. Both are rounded to 8 bits first, as these metrics expect."""
    check_installed(name)
    return {"flip": _flip, "ssimulacra2": _ssimulacra2}[name]


def _flip(picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]) -> float:
    """The mean LDR-FLIP error at its default of 67 pixels for a degree."""
    import flip_evaluator

    one, other = (eight_bit(image).astype(np.float32) / 255 for image in (truth, picture))
    return float(flip_evaluator.evaluate(one, other, "LDR", applyMagma=False)[1])


def _ssimulacra2(picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]) -> float:
    """The package reads pictures from files; these are PNG files in memory."""
    import ssimulacra2

    return float(ssimulacra2.compute_ssimulacra2(_png(truth), _png(picture)))


def _png(image: Tensor) -> io.BytesIO:
    return io.BytesIO(cv2.imencode(".png", eight_bit(image)[..., ::-1])[1].tobytes())
