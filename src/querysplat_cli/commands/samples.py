"""What `info` and `inspect` show of many numbers: their quantiles, and some of many points."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.quantiles import picked

QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
DRAWN_POINTS = 20_000
"""The most points of a drawing."""


def quantiles(values: Float[Tensor, "n"]) -> dict[str, float]:
    """The values at `QUANTILES`, by these as text. Each is one of `values`, of which there must be at least one."""
    return {f"{level:g}": value for level, value in zip(QUANTILES, picked(values, *QUANTILES).tolist(), strict=True)}


def drawn_points(count: int) -> Int[Tensor, "drawn"]:
    """Which of `count` points are drawn: `DRAWN_POINTS` of them by chance, the same ones each time; all of fewer."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:DRAWN_POINTS]
