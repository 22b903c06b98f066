"""The losses of training (paper, section 3.4), each a function of Gaussians and cameras, or of pictures."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras, distances
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.lpips import Perceptual, perceptual_loss
from querysplat_cli.splat.similarity import photometric_loss

EPSILON = 1e-6
"""The least opacity whose logarithm is taken."""
CHAMFER_PAIRS = 1 << 24
"""Distances that the Chamfer loss keeps in memory at once."""


def picture_loss(
    picture: Float[Tensor, "views 3 height width"],
    photo: Float[Tensor, "views 3 height width"],
    mask: Tensor,
    perceptual: Perceptual | None = None,
    weight: float = 0.0,
) -> Float[Tensor, ""]:
    """L1 + 0.2·(1 − SSIM)/2 over the mask, and `weight` times `perceptual` in float32 (paper, section 3.4)."""
    loss = photometric_loss(picture.float(), photo, mask)
    if perceptual is not None and weight:
        loss = loss + weight * perceptual_loss(perceptual, picture, photo, mask)
    return loss


def opacity_floor(opacities: Float[Tensor, "n"], alpha_min: float) -> Float[Tensor, ""]:
    """Mean of max(0, ln α_min − ln max(α, ε)): it raises opacities below `alpha_min` (paper, section 3.4).

    An opacity below ε has no gradient.
    """
    return (math.log(alpha_min) - torch.log(opacities.clamp_min(EPSILON))).clamp_min(0).mean()


def chamfer(a: Float[Tensor, "n 3"], b: Float[Tensor, "m 3"]) -> Float[Tensor, ""]:
    """Mean squared distance from each point to the nearest of the other set, both ways.

    The search for the neighbours has no gradient, and its memory is bounded by chunks. Coincident points have
    gradient zero. Where one set is empty, the loss is zero.
    """
    if not len(a) or not len(b):
        return a.sum() * 0
    forth = (a - b[nearest(a, b)]).square().sum(1).mean()
    back = (b - a[nearest(b, a)]).square().sum(1).mean()
    return forth + back


@torch.no_grad()
def nearest(points: Float[Tensor, "n 3"], among: Float[Tensor, "m 3"]) -> Int[Tensor, "n"]:
    """The number of the nearest of `among` for each point."""
    at_once = max(1, CHAMFER_PAIRS // len(among))
    return torch.cat([distances(some, among).argmin(1) for some in points.split(at_once)])


def depth_points(
    views: Views, cameras: Cameras, depth: Float[Tensor, "views height width"], count: int, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """At most `count` world points of the input-only depth, drawn evenly from the pixels inside the masks."""
    rows, columns = (torch.arange(size, device=depth.device) + 0.5 for size in depth.shape[1:])
    points = cameras.unproject(depth, columns, rows)[views.masks]
    return points[draw_indices(len(points), count, generator)]


def draw_indices(total: int, count: int, generator: torch.Generator) -> Int[Tensor, "n"]:
    """At most `count` of the indices below `total`, each at most once, in random order."""
    return torch.randperm(total, generator=generator)[:count]
