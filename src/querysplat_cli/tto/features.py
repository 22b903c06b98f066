"""Test-time optimisation in feature space (paper, section 3.4): the memories adapt, the network does not.

Keys and values of both branches are optimised with rendering losses on the input views; decoders, queries
and heads stay frozen. However many views there are, the network runs once a step: the gradients that the
views send to the Gaussians are summed, chunk by chunk, and go back through the decoders together.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from itertools import islice

import torch
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class TtoSettings:
    """How to optimise. `views_per_step` None takes every view in every step, as the paper's release does;
    a number draws that many, each view once before any comes again. The rate rises over `warm_up` steps."""

    steps: int
    lr: float
    views_per_step: int | None = None
    warm_up: int = 0


@dataclass(frozen=True)
class TtoStep:
    """The state before a step: its loss on the views of that step, and the seconds since the start."""

    step: int
    loss: float
    seconds: float


@dataclass(frozen=True)
class TtoResult:
    """The better of the first and the last state, by the loss over all views."""

    memories: Memories | Features
    loss_before: float
    loss_after: float
    history: tuple[TtoStep, ...]


def optimise_memories(
    model: QuerySplat,
    memories: Memories | Features,
    anchors: Anchors | None,
    target: RenderingLoss,
    settings: TtoSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[TtoStep], None] = lambda step: None,
) -> TtoResult:
    """Adam (β 0.9, 0.999) on the four memory tensors, or on the two of features that keys and values are made of.

    Its rate falls to a tenth along a cosine. When Gaussians or gradients stop being finite it starts again at
    half the rate, with the steps that are left; a last state that is worse than the first over all views is
    dropped.
    """
    everything = list(range(len(target.views)))
    with torch.no_grad():
        loss_before = target.value(model.decode(memories, anchors), everything)
    variables, optimiser, rate = _start(memories, settings.lr)
    history: list[TtoStep] = []
    start = time.perf_counter()
    for step, chosen in enumerate(islice(_draws(len(everything), settings.views_per_step, generator), settings.steps)):
        gaussians = model.decode(variables, anchors)
        if not _finite(_tensors(gaussians)):
            variables, optimiser, rate = _start(memories, rate / 2)
            continue
        loss, gradient = target.value_and_gradient(gaussians, chosen)
        optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(_tensors(gaussians), _tensors(gradient))
        history.append(TtoStep(step, loss, time.perf_counter() - start))
        progress(history[-1])
        if not _finite([tensor.grad for tensor in _tensors(variables) if tensor.grad is not None]):
            variables, optimiser, rate = _start(memories, rate / 2)
            continue
        fall = 0.55 + 0.45 * math.cos(math.pi * step / settings.steps)
        optimiser.param_groups[0]["lr"] = rate * fall * min(1.0, (step + 1) / max(1, settings.warm_up))
        optimiser.step()
    adapted = variables.map(Tensor.detach)
    with torch.no_grad():
        gaussians = model.decode(adapted, anchors)
        loss_after = target.value(gaussians, everything) if _finite(_tensors(gaussians)) else math.inf
    if not loss_after <= loss_before:
        adapted, loss_after = memories, loss_before
    return TtoResult(adapted, loss_before, loss_after, tuple(history))


def _start(memories: Memories | Features, rate: float) -> tuple[Memories | Features, torch.optim.Optimizer, float]:
    """Fresh variables at `memories`, and an optimiser for them."""
    variables = memories.map(lambda tensor: tensor.detach().clone().requires_grad_())
    return variables, torch.optim.Adam(_tensors(variables), lr=rate, fused=True), rate


def _finite(tensors: list[Tensor]) -> bool:
    return all(bool(tensor.detach().isfinite().all()) for tensor in tensors)


def _tensors(holder: Memories | Features | Gaussians) -> list[Tensor]:
    return [getattr(holder, field.name) for field in fields(holder)]


def _draws(views: int, at_once: int | None, generator: torch.Generator) -> Iterator[list[int]]:
    """Endless sets of views, each view once before any comes again."""
    waiting: list[int] = []
    while True:
        if at_once is None or at_once >= views:
            yield list(range(views))
            continue
        if len(waiting) < at_once:
            waiting += torch.randperm(views, generator=generator).tolist()
        yield [waiting.pop(0) for _ in range(at_once)]
