"""Test-time optimisation in feature space (paper, section 3.5): the memories adapt, the network does not.

Keys and values of both branches, or the tokens that they are made of, are optimised with rendering losses on
the input views. Decoders, queries and heads stay frozen.
"""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.smoothing import convolved
from querysplat_cli.tto.optimise import TtoResult, optimise
from querysplat_cli.tto.options import NO_CALLBACKS, Callbacks, TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.variables import Parametrisation

M = TypeVar("M", bound=Memories | Features)


@dataclass(frozen=True)
class Start(Generic[M]):
    """What optimisation starts with.

    `gaussians` is the scene where the variables no longer decode to it, else None. `kept` marks the decoded Gaussians
    that belong to the scene (None: all). `finest` are cameras for whose pixels decoded Gaussians are smoothed
    (`splat/smoothing.py`; None: they stay as decoded). `origin` is where variable features began, for models whose
    values have a residual path from the change of the features; None for others, and for memories.
    """

    variables: M
    anchors: Anchors | None
    gaussians: Gaussians | None = None
    kept: Bool[Tensor, "n"] | None = None
    finest: Cameras | None = None
    origin: Features | None = None

    def narrowed(self, kept: Bool[Tensor, "m"]) -> "Start[M]":
        """With only those of the scene's Gaussians that are `kept`."""
        if self.gaussians is not None:
            return replace(self, gaussians=self.gaussians[kept])
        if self.kept is None:
            return replace(self, kept=kept)
        fewer = self.kept.clone()
        fewer[self.kept] = kept
        return replace(self, kept=fewer)


def optimise_memories(
    model: QuerySplat,
    start: Start[M],
    target: RenderingLoss,
    settings: TtoSettings,
    *,
    generator: torch.Generator,
    callbacks: Callbacks = NO_CALLBACKS,
    refine_cameras: bool = False,
) -> TtoResult[M]:
    """`optimise` for the four tensors of memories, or for the two of features; all at the same rate."""
    rates = dict.fromkeys(start.variables.named(), 1.0)
    return optimise(
        Parametrisation(start.variables, lambda variables: _decoded(model, replace(start, variables=variables)), rates),
        target,
        settings,
        generator=generator,
        callbacks=callbacks,
        refine_cameras=refine_cameras,
    )


def gaussians_of(model: QuerySplat, start: Start[M]) -> Gaussians:
    """The Gaussians of the scene."""
    if start.gaussians is not None:
        return start.gaussians
    with torch.no_grad():
        return _decoded(model, start)


def memories_of(model: QuerySplat, start: Start[M]) -> Memories:
    """The memories that the variables stand for."""
    if isinstance(start.variables, Memories):
        return start.variables
    return model.keys_and_values(start.variables, start.origin)


def _decoded(model: QuerySplat, start: Start[M]) -> Gaussians:
    gaussians = model.decode(memories_of(model, start), start.anchors)
    gaussians = gaussians if start.kept is None else gaussians[start.kept]
    return gaussians if start.finest is None else convolved(gaussians, start.finest)
