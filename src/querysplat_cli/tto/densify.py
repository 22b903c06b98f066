"""More Gaussians where renders and photos disagree, as in 3DGS; chosen by the pictures' error alone."""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.splat.blending_weights import three_blending_weights
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss

SPLIT_DISTANCE = 0.5
"""From the centre of a Gaussian to the centres of its two parts, in standard deviations of its longest axis."""


@dataclass(frozen=True)
class Densified:
    """More Gaussians. `origin` is for each the row that it was made of; one that was split has two, one that went none.

    `guessed` is that of `Share`.
    """

    gaussians: Gaussians
    origin: Int[Tensor, "n"]
    guessed: Float[Tensor, "n"]


@dataclass(frozen=True)
class Share:
    """What each Gaussian has a part in, over all views.

    error: the absolute error of every pixel times the Gaussian's blending weight in it, added up.
    weight: the blending weights, added up.
    guessed: the share of that weight that lies in guessed pixels (`RenderingLoss.guessed`).
    """

    error: Float[Tensor, "n"]
    weight: Float[Tensor, "n"]
    guessed: Float[Tensor, "n"]

    @classmethod
    def of(cls, gaussians: Gaussians, target: RenderingLoss) -> "Share":
        """Pixels beside a smaller photo, on the canvas of a larger one, count for nothing."""
        total = gaussians.opacities.new_zeros(3, len(gaussians))
        for view in range(len(target.views)):
            camera, photo = target.cameras[[view]], target.views.picture(view)
            with torch.no_grad():
                picture = target.recorded(target.render(gaussians, view).over(target.background)[0], photo)
                error = (picture - photo).abs().mean(0) * target.views.masks[view]
            (height, width), shown = target.views.sizes[view], torch.zeros_like(error)
            shown[:height, :width] = 1  # the padding of a smaller photo says nothing of what was guessed
            pixels = torch.stack([error, target.guessed(view)[0].to(error), shown])
            total += three_blending_weights(gaussians, camera, pixels, target.settings)
        error_of_each, guessed, weight = total
        return cls(error_of_each, weight, guessed / weight.clamp_min(1e-12))


def densify(gaussians: Gaussians, target: RenderingLoss, count: int) -> Densified:
    """Split the Gaussians of the largest `Share.error`, each once, until there are `count` or all were split.

    Before that go those that are faint and hardly needed (`_needless`).
    """
    share = Share.of(gaussians, target)
    left = (~_needless(gaussians, share)).nonzero()[:, 0]
    order = left[share.error[left].argsort(descending=True, stable=True)]
    chosen, others = order.tensor_split([max(0, count - len(left))])
    others = others.sort().values
    parts = gaussians[others], *split(gaussians[chosen])
    whole = {field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(gaussians)}
    origin = torch.cat([others, chosen, chosen])
    return Densified(Gaussians(**whole), origin, share.guessed[origin])


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


def _needless(gaussians: Gaussians, share: Share) -> Bool[Tensor, "n"]:
    """Those fainter than `TtoPolicy.faint` of which most colours guessed pixels, as far as the photos hardly need them.

    Together they have `TtoPolicy.faint_weight` of all blending weight at most, and those of the least weight come
    first. Beyond that, many faint Gaussians are a surface, or one is a whole background.
    """
    faint = (gaussians.opacities < TTO_POLICY.faint) & (share.guessed > 0.5)
    by_weight = share.weight.argsort(stable=True)
    rows = by_weight[faint[by_weight]]
    go = share.weight[rows].cumsum(0) <= TTO_POLICY.faint_weight * share.weight.sum()
    faint[rows[~go]] = False
    return faint
