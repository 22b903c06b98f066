"""What changes while a model is trained: rates, weights, the number of queries, which samples count, the average."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.training.config import LossSettings, OptimiserSettings, StageSettings

PERTURBATION = 0.01
"""Standard deviation of what tells a copied query from its original, that of queries at the start."""


def rate(step: int, stage: StageSettings) -> float:
    """The learning rate of a stage's step: a linear rise over the warm-up, then a cosine to zero."""
    rise = max(1, round(stage.warm_up * stage.steps))
    if step < rise:
        return stage.lr * (step + 1) / rise
    return stage.lr * 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, stage.steps - rise)))


@dataclass(frozen=True)
class Weights:
    """Of the losses at one step."""

    perceptual: float
    visibility: float
    chamfer: float
    opacity_floor: float


def weights(step: int, losses: LossSettings) -> Weights:
    """LPIPS ramps up after its start, early regularisation falls to zero."""
    ramp = (step - losses.lpips_start) / max(1, losses.lpips_ramp)
    early = max(0.0, 1 - step / losses.anneal)
    return Weights(
        losses.lpips * min(1.0, max(0.0, ramp)), losses.visibility, losses.chamfer * early, losses.opacity_floor * early
    )


def grow_queries(model: QuerySplat, count: int, generator: torch.Generator) -> None:
    """Have `count` learned queries: copies of those there are, in turn, the copies slightly perturbed.

    A model that has more keeps the first ones.
    """
    before = model.config.query_count
    with torch.no_grad():
        for name in ("geometry_queries", "appearance_queries"):
            queries = getattr(model, name)
            copies = queries[torch.arange(max(0, count - before)) % before]
            noise = PERTURBATION * torch.randn(copies.shape, generator=generator).to(copies)
            setattr(model, name, nn.Parameter(torch.cat([queries, copies + noise])[:count].clone()))
    model.config = replace(model.config, query_count=count)


class RankFilter:
    """Leaves out samples whose loss ranks above a share of the latest ones.

    The window is the same on every process when all see the same losses in the same order.
    """

    def __init__(self, settings: OptimiserSettings, window: Sequence[float] = ()) -> None:
        self._settings = settings
        self.window = list(window)

    def keeps(self, loss: float, progress: float) -> bool:
        """Whether a sample counts, `progress` of the training being done."""
        settings = self._settings
        full = len(self.window) >= settings.window
        if progress < settings.keep_from or settings.keep >= 1 or not full:
            return True
        return loss <= sorted(self.window)[math.ceil(settings.keep * len(self.window)) - 1]

    def add(self, losses: Sequence[float]) -> None:
        """Losses of a step, those of samples that were left out included."""
        self.window = (self.window + [loss for loss in losses if math.isfinite(loss)])[-self._settings.window :]


class Average:
    """Exponential moving average of a model's trained tensors, in float32."""

    def __init__(self, model: nn.Module, decay: float, values: Mapping[str, Tensor] | None = None) -> None:
        self._decay = decay
        self.values = {
            name: (values[name] if values else tensor).detach().float().clone() for name, tensor in trained(model)
        }

    def update(self, model: nn.Module, step: int) -> None:
        """After a step. Early on the average is shorter, so that the start is soon forgotten."""
        decay = min(self._decay, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, tensor in trained(model):
                if self.values[name].shape != tensor.shape:
                    self.values[name] = tensor.detach().float().clone()
                self.values[name].lerp_(tensor.detach().float(), 1 - decay)


def trained(model: nn.Module) -> Iterator[tuple[str, nn.Parameter]]:
    """Parameters that are not frozen, by name."""
    return ((name, tensor) for name, tensor in model.named_parameters() if tensor.requires_grad)
