"""Test-time optimisation in feature space (paper, section 3.4): the memories adapt, the network does not.

Keys and values of both branches, or the tokens that they are made of, are optimised with rendering losses on
the input views; decoders, queries and heads stay frozen.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

import torch

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.tto.optimise import TtoResult, TtoSettings, TtoStep, optimise
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
) -> TtoResult[M]:
    """`optimise` for the four memory tensors, or for the two of features; all at the same rate."""
    return optimise(
        memories,
        lambda variables: model.decode(variables, anchors),
        target,
        settings,
        rates={field.name: 1.0 for field in fields(memories)},
        generator=generator,
        progress=progress,
    )
