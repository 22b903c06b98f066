"""Test-time optimisation in feature space (paper, section 3.4): the memories adapt, the network does not.

Keys and values of both branches, or the tokens that they are made of, are optimised with rendering losses on
the input views; decoders, queries and heads stay frozen.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.optimise import Pruning, TtoResult, TtoSettings, TtoStep, optimise
from querysplat_cli.tto.rendering_loss import RenderingLoss

M = TypeVar("M", bound=Memories | Features)


def optimise_memories(
    model: QuerySplat,
    memories: M,
    anchors: Anchors | None,
    target: RenderingLoss,
    settings: TtoSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[TtoStep], None] = lambda step: None,
    kept: Bool[Tensor, "n"] | None = None,
    pruning: Pruning | None = None,
    refine_cameras: bool = False,
) -> TtoResult[M]:
    """`optimise` for the four memory tensors, or for the two of features; all at the same rate.

    `kept` says which of the decoded Gaussians an earlier pruning left.
    """
    return optimise(
        memories,
        lambda variables: decoded(model, variables, anchors, kept),
        target,
        settings,
        rates={field.name: 1.0 for field in fields(memories)},
        generator=generator,
        progress=progress,
        pruning=pruning,
        refine_cameras=refine_cameras,
    )


def decoded(
    model: QuerySplat, variables: Memories | Features, anchors: Anchors | None, kept: Bool[Tensor, "n"] | None
) -> Gaussians:
    """The Gaussians of a scene of which some were pruned."""
    gaussians = model.decode(variables, anchors)
    return gaussians if kept is None else gaussians[kept]
