"""What changes during a training: learning rate, loss weights, number of queries, sample filter, weight average."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.training.config import LossSettings, OptimiserSettings, StageSettings
from querysplat_cli.training.policy import TRAINING_POLICY


def rate(step: int, stage: StageSettings) -> float:
    """The learning rate at step `step` of a stage: a linear rise over the warm-up, then a cosine to zero."""
    rise = max(1, round(stage.warm_up * stage.steps))
    if step < rise:
        return stage.lr * (step + 1) / rise
    return stage.lr * 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, stage.steps - rise)))


@dataclass(frozen=True)
class Weights:
    """Weights of the losses at one step."""

    perceptual: float
    visibility: float
    chamfer: float
    opacity_floor: float


def weights(step: int, losses: LossSettings) -> Weights:
    """The weight of LPIPS rises after its start; those of the Chamfer loss and the opacity floor fall to zero."""
    ramp = (step - losses.lpips_start) / max(1, losses.lpips_ramp)
    early = max(0.0, 1 - step / losses.anneal)
    return Weights(
        losses.lpips * min(1.0, max(0.0, ramp)), losses.visibility, losses.chamfer * early, losses.opacity_floor * early
    )


def grow_queries(model: QuerySplat, count: int, generator: torch.Generator) -> None:
    """Give the model `count` learned queries. The new ones are copies of the others, in turn, with a little noise.

    A model with more queries than that keeps the first `count`.
    """
    before = model.config.query_count
    with torch.no_grad():
        for name in ("geometry_queries", "appearance_queries"):
            queries = getattr(model, name)
            copies = queries[torch.arange(max(0, count - before)) % before]
            noise = TRAINING_POLICY.query_noise * torch.randn(copies.shape, generator=generator).to(copies)
            setattr(model, name, nn.Parameter(torch.cat([queries, copies + noise])[:count].clone()))
    model.config = replace(model.config, query_count=count)


class RankFilter:
    """Leaves out samples whose loss ranks above a share of the latest ones.

    The window is the same on every process when all add the same losses in the same order.
    """

    def __init__(self, settings: OptimiserSettings, window: Sequence[float] = ()) -> None:
        self._settings = settings
        self.window = list(window)

    def keeps(self, loss: float, progress: float) -> bool:
        """Whether a sample of this loss gives a gradient. `progress` is the share of the training that is done."""
        settings = self._settings
        full = len(self.window) >= settings.window
        if progress < settings.keep_from or settings.keep >= 1 or not full:
            return True
        return loss <= sorted(self.window)[math.ceil(settings.keep * len(self.window)) - 1]

    def add(self, losses: Sequence[float]) -> None:
        """Add the losses of a step, also those of samples that were left out."""
        self.window = (self.window + [loss for loss in losses if math.isfinite(loss)])[-self._settings.window :]


class Average:
    """Exponential moving average of a model's trained tensors, in float32."""

    def __init__(self, model: nn.Module, decay: float, values: Mapping[str, Tensor] | None = None) -> None:
        self._decay = decay
        self.values = {
            name: (values[name] if values else tensor).detach().to(tensor.device, torch.float32, copy=True)
            for name, tensor in trained(model)
        }

    def fit(self, model: nn.Module) -> None:
        """Start anew with tensors that have another shape by now."""
        for name, tensor in trained(model):
            if self.values[name].shape != tensor.shape:
                self.values[name] = tensor.detach().float().clone()

    def update(self, model: nn.Module, step: int) -> None:
        """Add the weights after `step`. The decay is lower in the first steps, so that initial weights fade soon."""
        decay = min(self._decay, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, tensor in trained(model):
                self.values[name].lerp_(tensor.detach().float(), 1 - decay)


def trained(model: nn.Module) -> Iterator[tuple[str, nn.Parameter]]:
    """Names and values of the parameters that are not frozen."""
    return ((name, tensor) for name, tensor in model.named_parameters() if tensor.requires_grad)
