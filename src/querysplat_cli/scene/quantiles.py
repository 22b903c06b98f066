"""Quantiles of any number of values: torch's own takes at most 2**24."""

from jaxtyping import Shaped
from torch import Tensor


def picked(values: Shaped[Tensor, "n *rest"], *shares: float) -> Shaped[Tensor, "shares *rest"]:
    """The values below which the `shares` of all lie, each one of `values`, along the first axis."""
    ordered = values.sort(0).values
    return ordered[[round(share * (len(ordered) - 1)) for share in shares]]
