"""Raw numbers to Gaussians: absolute, as in the official checkpoints, or as changes to an anchor's prior."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_product, rotate_vectors

OPACITY_BIAS = 2.0
LARGEST_EXPONENT = 40.0
"""Beyond this exp continues as its tangent: for a raw number of 1e4, it and its squared gradient stay finite."""
SHRINK, GROW = -4.0, 2.0
"""Bounds of the change of a prior's log-scale."""


def signed_exponential(raw: Tensor) -> Tensor:
    """sign(x)·(e^|x| − 1), continued by its tangent beyond |x| = 40.

    Its slope at 0 is 1. Written with |x| and sign(x), automatic differentiation would give 0 there, and centres that
    start at their prior would never move.
    """
    inside = raw.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT)
    value = torch.where(raw > 0, torch.expm1(inside), -torch.expm1(-inside))
    # A choice, not a sum: in a sum, rounding to the tangent's slope of e^40 would lose the other slope.
    return torch.where(raw == inside, value, value + (raw - inside) * math.exp(LARGEST_EXPONENT))


def activate_geometry(
    raw: Float[Tensor, "*n 10"], config: ModelConfig
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n 3"], Float[Tensor, "*n 4"]]:
    """Centre without its z offset, scale, quaternion (paper, section 3.3). A raw quaternion of 0 stays 0."""
    cap = math.log(config.scale_cap)
    scale = torch.exp((raw[..., 3:6] - (1 - cap)).clamp_max(cap))
    return signed_exponential(raw[..., :3]), scale, F.normalize(raw[..., 6:], dim=-1)


def activate_appearance(
    raw: Float[Tensor, "*n channels"], config: ModelConfig
) -> tuple[Float[Tensor, "*n bands 3"], Float[Tensor, "*n"]]:
    """SH coefficients and opacity (paper, section 3.3)."""
    bands = raw[..., :-1].unflatten(-1, (config.sh_bands, 3))
    first = 0.5 * torch.tanh(bands[..., :1, :]) / SH_0
    rest = config.sh_rest_scale * torch.tanh(bands[..., 1:, :])
    return torch.cat([first, rest], -2), torch.sigmoid(raw[..., -1] - OPACITY_BIAS)


def assemble(
    geometry: Float[Tensor, "n 10"], appearance: Float[Tensor, "n channels"], config: ModelConfig
) -> Gaussians:
    """Gaussians in the VGM's frame."""
    centre, scale, quat = activate_geometry(geometry, config)
    sh, opacity = activate_appearance(appearance, config)
    offset = centre.new_tensor([0.0, 0.0, config.z_offset])
    return Gaussians(centre + offset, quat, scale, opacity, sh)


def assemble_anchored(
    geometry: Float[Tensor, "n 10"], appearance: Float[Tensor, "n channels"], anchors: Anchors, config: ModelConfig
) -> Gaussians:
    """Changes to the anchors' priors; raw numbers of 0 give exactly the prior.

    Centres move along the prior's own axes in units of the anchor's spacing, log-scales add, quaternions
    multiply, colours add in SH units, opacities add in logits.
    """
    per_query = anchors.means.shape[1]
    spacing = anchors.spacing.repeat_interleave(per_query)[:, None]
    turn = geometry[:, 6:] + geometry.new_tensor([1.0, 0, 0, 0])
    # What F.normalize does, in a third of the time for rows of four.
    turn = turn * turn.square().sum(1, keepdim=True).clamp_min(1e-24).rsqrt()
    bands = appearance[:, :-1].unflatten(-1, (config.sh_bands, 3))
    first = (anchors.colours.flatten(0, 1)[:, None] - 0.5) / SH_0 + bands[:, :1]
    rest = torch.tanh(bands[:, 1:])
    quats = anchors.quats.flatten(0, 1)
    return Gaussians(
        means=anchors.means.flatten(0, 1) + rotate_vectors(quats, spacing * signed_exponential(geometry[:, :3])),
        quats=quaternion_product(quats, turn),
        scales=anchors.scales.flatten(0, 1) * torch.exp(geometry[:, 3:6].clamp(SHRINK, GROW)),
        opacities=torch.sigmoid(torch.logit(anchors.opacities.flatten(), eps=1e-6) + appearance[:, -1]),
        sh=torch.cat([first, rest], 1),
    )
