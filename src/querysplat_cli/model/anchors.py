"""Anchors: the prior that an anchored query starts from, and what it may attend to."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Neighbours:
    """The rows of a memory that each query may attend to.

    `bias` is added to the attention logits (a penalty on distance), the same for all heads.
    """

    index: Int[Tensor, "queries near"]
    bias: Float[Tensor, "queries near"]


@dataclass(frozen=True)
class Reading:
    """How much each query attended to its row of each view in the last round of refinement.

    The attention of both branches is the mean over heads and blocks. What is missing to 1 went to a row of zeros.
    `views` are the numbers of the views that a query read.
    """

    views: Int[Tensor, "queries views"]
    geometry: Float[Tensor, "queries views"]
    appearance: Float[Tensor, "queries views"]

    @classmethod
    def none(cls, queries: int) -> "Reading":
        """That of queries that were not refined."""
        return cls(torch.zeros(queries, 0, dtype=torch.int32), torch.zeros(queries, 0), torch.zeros(queries, 0))


@dataclass(frozen=True)
class Anchors:
    """Q anchored queries of G Gaussians each, in world coordinates.

    The prior (`means`, `scales`, `quats` w x y z, `opacities`, `colours` in [0, 1]) is the scene without any
    decoder. Heads predict changes to it, lengths in units of `spacing`, which is in scene units. `features` are the
    input of the query embedding and do not depend on the scene's frame. `geometry`, `appearance` and `queries` are
    the rows of the two memories, and the other queries, that each query attends to. `refinement` holds what rounds of
    feedback add to the raw numbers of both heads, those of the geometry first; it is 0 wide where there were none, and
    so is the `reading` of the last of them.
    """

    means: Float[Tensor, "queries gaussians 3"]
    scales: Float[Tensor, "queries gaussians 3"]
    quats: Float[Tensor, "queries gaussians 4"]
    opacities: Float[Tensor, "queries gaussians"]
    colours: Float[Tensor, "queries gaussians 3"]
    spacing: Float[Tensor, "queries"]
    features: Float[Tensor, "queries channels"]
    geometry: Neighbours
    appearance: Neighbours
    queries: Neighbours
    refinement: Float[Tensor, "queries gaussians refined"]
    reading: Reading

    def __len__(self) -> int:
        return len(self.means)
