"""More Gaussians where renders and photos disagree, as in 3DGS; chosen by the pictures' error alone."""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.tto.rendering_loss import RenderingLoss

SPLIT_DISTANCE = 0.5
"""From the centre of a Gaussian to the centres of its two parts, in standard deviations of its longest axis."""


@dataclass(frozen=True)
class Densified:
    """More Gaussians. `origin` is for each the row that it was made of; a Gaussian that was split has two."""

    gaussians: Gaussians
    origin: Int[Tensor, "n"]


def densify(gaussians: Gaussians, target: RenderingLoss, count: int) -> Densified:
    """Split the Gaussians of the largest `disagreement`, each once, until there are `count` or all were split."""
    order = disagreement(gaussians, target).argsort(descending=True, stable=True)
    chosen, others = order.tensor_split([max(0, count - len(gaussians))])
    others = others.sort().values
    parts = gaussians[others], *split(gaussians[chosen])
    whole = {field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(gaussians)}
    return Densified(Gaussians(**whole), torch.cat([others, chosen, chosen]))


def split(gaussians: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Two halves of each Gaussian along its longest axis, `SPLIT_DISTANCE` standard deviations σ to either side.

    With d for `SPLIT_DISTANCE`, the halves together keep the centre and the covariance when their standard deviation
    along the axis is w·σ with w² = 1 − d². As in 3DGS-MCMC (Kheradmand 2024), they also keep the integral of α over a
    picture that shows the axis from the side. Their opacity p then solves 2wp − a·p² = opacity, where
    a = w·exp(−d²/w²)/2 is what their overlap takes.
    """
    longest = gaussians.scales.argmax(1)
    rows = torch.arange(len(longest), device=longest.device)
    narrower = math.sqrt(1 - SPLIT_DISTANCE**2)
    overlap = narrower * math.exp(-((SPLIT_DISTANCE / narrower) ** 2)) / 2
    axis = quaternion_to_matrix(gaussians.quats)[rows, :, longest]
    aside = SPLIT_DISTANCE * gaussians.scales[rows, longest, None] * axis
    scales = gaussians.scales.clone()
    scales[rows, longest] *= narrower
    opacities = (narrower - (narrower**2 - overlap * gaussians.opacities).sqrt()) / overlap
    half = replace(gaussians, scales=scales, opacities=opacities)
    return replace(half, means=half.means + aside), replace(half, means=half.means - aside)


def disagreement(gaussians: Gaussians, target: RenderingLoss) -> Float[Tensor, "n"]:
    """The absolute error of every pixel of every view, times each Gaussian's blending weight in it, added up."""
    total = torch.zeros_like(gaussians.opacities)
    for view in range(len(target.views)):
        camera, photo = target.cameras[[view]], target.views.picture(view)
        with torch.no_grad():
            picture = target.render(gaussians, view).over(target.background)[0]
            error = (picture - photo).abs().mean(0) * target.views.masks[view]
        total += blending_weights(gaussians, camera, error[None], target.settings)
    return total
