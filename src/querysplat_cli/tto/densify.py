"""More Gaussians where renders and photos disagree, as 3DGS adds them, chosen by the pictures' error alone."""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.splat.render import render
from querysplat_cli.tto.rendering_loss import RenderingLoss

APART = 0.5
"""How far the two parts of a Gaussian lie from its centre, in standard deviations of its longest axis."""


@dataclass(frozen=True)
class Densified:
    """More Gaussians, and the old row that each was made of: two rows name one that was split."""

    gaussians: Gaussians
    origin: Int[Tensor, "n"]


def densify(gaussians: Gaussians, target: RenderingLoss, count: int) -> Densified:
    """Split, each once, those of the most `disagreement`, until there are `count` or all were split."""
    order = disagreement(gaussians, target).argsort(descending=True, stable=True)
    chosen, others = order.tensor_split([max(0, count - len(gaussians))])
    others = others.sort().values
    parts = gaussians[others], *split(gaussians[chosen])
    whole = {field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(gaussians)}
    return Densified(Gaussians(**whole), torch.cat([others, chosen, chosen]))


def split(gaussians: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Two halves of each Gaussian along its longest axis, `APART` standard deviations σ to either side.

    The two together have its centre and covariance, so σ' = w·σ with w² = 1 − APART². As 3DGS-MCMC (Kheradmand 2024)
    asks, the integral of α stays as it was, over a picture that sees the axis from the side: 2wp − a·p² = opacity
    for their opacity p, with a = w·exp(−APART²/w²)/2 from where they overlap.
    """
    longest = gaussians.scales.argmax(1)
    rows = torch.arange(len(longest), device=longest.device)
    narrower = math.sqrt(1 - APART**2)
    overlap = narrower * math.exp(-((APART / narrower) ** 2)) / 2
    axis = quaternion_to_matrix(gaussians.quats)[rows, :, longest]
    aside = APART * gaussians.scales[rows, longest, None] * axis
    scales = gaussians.scales.clone()
    scales[rows, longest] *= narrower
    opacities = (narrower - (narrower**2 - overlap * gaussians.opacities).sqrt()) / overlap
    half = replace(gaussians, scales=scales, opacities=opacities)
    return replace(half, means=half.means + aside), replace(half, means=half.means - aside)


def disagreement(gaussians: Gaussians, target: RenderingLoss) -> Float[Tensor, "n"]:
    """The absolute error of every pixel of every view, times each Gaussian's blending weight in it, added up."""
    grey = replace(gaussians.detach(), sh=torch.zeros_like(gaussians.sh[:, :1]).requires_grad_())
    total = torch.zeros_like(grey.opacities)
    for view in range(len(target.views)):
        camera, photo = target.cameras[[view]], target.views.images[view]
        with torch.no_grad():
            picture = render(gaussians, camera, background=target.background, settings=target.settings).colour[0]
            error = (picture - photo).abs().mean(0) * target.views.masks[view]
        with torch.enable_grad():
            red = render(grey, camera, settings=target.settings).colour[0, 0]
            (slope,) = torch.autograd.grad((red * error).sum(), grey.sh)
        total += slope[:, 0, 0] / SH_0
    return total
