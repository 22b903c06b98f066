"""Test-time optimisation in Gaussian space: the Gaussians themselves adapt, from whatever made them.

Every variable is a number without units, so that one rate suits scenes of any size and Gaussians of any
shape: centres move in units of the Gaussian's longest axis, scales are logarithms, opacities logits. The shortest
axis sets no step: pictures blur a needle or an edge-on disc to half a pixel anyhow, and in units of its
thickness it would hardly move.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.densify import densify
from querysplat_cli.tto.optimise import TtoResult, optimise
from querysplat_cli.tto.options import NO_CALLBACKS, Callbacks, TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.variables import Denser, Parametrisation

RATES = {"moves": 1.0, "turns": 0.5, "log_scales": 1.0, "logits": 2.0, "colours": 0.5, "bands": 0.1}
"""Steps of the variables relative to the learning rate. Colours are SH numbers, of which 1 is 0.28 of a channel;
what depends on direction learns slowly, since it can explain one view and spoil all others."""
LARGEST = 8.0
"""A log-scale, a logit or a move, in units of the start, stays within this of where it began."""


@dataclass(frozen=True)
class Changes:
    """Changes to N Gaussians; zeros leave them as they are."""

    moves: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    logits: Float[Tensor, "n"]
    colours: Float[Tensor, "n 1 3"]
    bands: Float[Tensor, "n rest 3"]

    def map(self, change: Callable[[Tensor], Tensor]) -> "Changes":
        """The result of applying `change` to every tensor."""
        return Changes(**{field.name: change(getattr(self, field.name)) for field in fields(self)})

    @classmethod
    def none(cls, gaussians: Gaussians) -> "Changes":
        """No change."""
        sh = torch.zeros_like(gaussians.sh)
        return cls(
            torch.zeros_like(gaussians.means),
            torch.zeros_like(gaussians.quats),
            torch.zeros_like(gaussians.scales),
            torch.zeros_like(gaussians.opacities),
            sh[:, :1],
            sh[:, 1:],
        )


def optimise_gaussians(
    gaussians: Gaussians,
    target: RenderingLoss,
    settings: TtoSettings,
    *,
    generator: torch.Generator,
    callbacks: Callbacks = NO_CALLBACKS,
    densify_to: int | None = None,
    refine_cameras: bool = False,
) -> TtoResult[Changes]:
    """`optimise` for changes to `gaussians`, which are split on the way until there are `densify_to`.

    Changes are then those since the last time that some were split.
    """

    def denser(some: Gaussians, target: RenderingLoss, rounds: int) -> Denser[Changes]:
        assert densify_to
        more = densify(some, target, round(len(some) * (densify_to / len(some)) ** (1 / rounds)))
        return Denser(Changes.none(more.gaussians), partial(changed, more.gaussians), more.origin)

    return optimise(
        Parametrisation(
            Changes.none(gaussians), partial(changed, gaussians), RATES, densify=denser if densify_to else None
        ),
        target,
        settings,
        generator=generator,
        callbacks=callbacks,
        refine_cameras=refine_cameras,
    )


def changed(gaussians: Gaussians, changes: Changes) -> Gaussians:
    """`gaussians` after `changes`: moves in the world, in units of the largest standard deviation of each."""
    moves = LARGEST * torch.tanh(changes.moves / LARGEST)
    logits = torch.logit(gaussians.opacities, eps=1e-6)
    return Gaussians(
        means=gaussians.means + moves * gaussians.scales.amax(1, keepdim=True),
        quats=F.normalize(F.normalize(gaussians.quats, dim=1) + changes.turns, dim=1),
        scales=gaussians.scales * torch.exp(changes.log_scales.clamp(-LARGEST, LARGEST)),
        opacities=torch.sigmoid(logits + changes.logits),
        sh=gaussians.sh + torch.cat([changes.colours, changes.bands], 1),
    )
