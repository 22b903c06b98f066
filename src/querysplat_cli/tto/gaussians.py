"""Test-time optimisation in Gaussian space: the Gaussians themselves adapt.

Every variable is a number without units, so that one rate suits scenes of any size and Gaussians of any shape.
Centres move in units of the Gaussian's longest axis, scales are logarithms, and opacities are logits. The shortest axis
sets no step. Pictures blur a needle or an edge-on disc to half a pixel, and in units of its thickness it would hardly
move.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.prune.far import drawn_in
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.tto.densify import densify
from querysplat_cli.tto.optimise import TtoResult, optimise
from querysplat_cli.tto.options import NO_CALLBACKS, Callbacks, TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.scale_bounds import bounding
from querysplat_cli.tto.variables import Denser, Parametrisation

LARGEST_CHANGE = 8.0
"""Bound of a move or of a log-scale's fall, so that no step overflows."""
LARGEST_GROWTH = 1.0
"""Bound of a log-scale's rise from the last split to the next. Faint Gaussians would otherwise become giants, which no
photo forbids, and which other views show."""


@dataclass(frozen=True)
class Changes(TensorDataclass):
    """Changes to N Gaussians. Zeros leave them as they are; units are those of `changed`."""

    moves: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    logits: Float[Tensor, "n"]
    colours: Float[Tensor, "n 1 3"]
    bands: Float[Tensor, "n rest 3"]

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

    No scale falls below the pixels of `target.finest`, and none becomes a giant's (`tto/scale_bounds.py`).

    The variables of the result are the changes since the last split.
    """

    def denser(some: Gaussians, target: RenderingLoss, rounds: int) -> Denser[Changes]:
        assert densify_to
        # What the end would do to far and giant Gaussians is done now, while the others can adapt to it.
        some = drawn_in(some, target.finest) if target.finest else some
        more = densify(some, target, round(len(some) * (densify_to / len(some)) ** (1 / rounds)))
        return Denser(
            Changes.none(more.gaussians),
            bounding(partial(changed, more.gaussians), target.finest),
            more.origin,
            TTO_POLICY.guessed_opacity * more.guessed / len(more.guessed) if rounds > 1 else None,
        )

    return optimise(
        Parametrisation(
            Changes.none(gaussians),
            bounding(partial(changed, gaussians), target.finest),
            TTO_POLICY.gaussian_rates,
            densify=denser if densify_to else None,
        ),
        target,
        settings,
        generator=generator,
        callbacks=callbacks,
        refine_cameras=refine_cameras,
    )


def changed(gaussians: Gaussians, changes: Changes) -> Gaussians:
    """`gaussians` after `changes`.

    Moves are in world axes, in units of each Gaussian's largest standard deviation; turns are added to the unit
    quaternion; scales change by logarithms, opacities by logits.
    """
    moves = LARGEST_CHANGE * torch.tanh(changes.moves / LARGEST_CHANGE)
    grown = LARGEST_GROWTH * torch.tanh(changes.log_scales / LARGEST_GROWTH)
    log_scales = torch.where(changes.log_scales > 0, grown, changes.log_scales.clamp_min(-LARGEST_CHANGE))
    logits = torch.logit(gaussians.opacities, eps=1e-6)
    return Gaussians(
        means=gaussians.means + moves * gaussians.scales.amax(1, keepdim=True),
        quats=F.normalize(F.normalize(gaussians.quats, dim=1) + changes.turns, dim=1),
        scales=gaussians.scales * torch.exp(log_scales),
        opacities=torch.sigmoid(logits + changes.logits),
        sh=gaussians.sh + torch.cat([changes.colours, changes.bands], 1),
    )
