"""The visibility loss: it draws Gaussians into the pictures.

Without it, a Gaussian that no view sees would get no gradient from the picture losses.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras

PIXEL_AT_INFINITY = 1e6
"""Pixel coordinate that stands for the projection of a point in a camera's plane z = 0."""
PLANE_Z = 1e-12
"""A point whose camera z is nearer to 0 counts as in that plane."""


def unseen_loss(
    centres: Float[Tensor, "n 3"], cameras: Sequence[Cameras], near: float, limit: float = 1.0
) -> Float[Tensor, ""]:
    """Mean over the centres of the distance to the view that is nearest to seeing them (paper, section 3.4).

    For a centre in front of a view's near plane, the distance is that of its projection from the picture, in half
    picture sizes (L1 over both axes). For one behind that plane, it is the distance to the plane, in scene units. The
    least over all views of all `cameras` counts. Distances above `limit` count as `limit` and have no gradient; 0 means
    no limit.
    """
    distances = []
    for each in cameras:
        behind = near - (each.w2c[:, 2, :3] @ centres.T + each.w2c[:, 2, 3:])
        distances.append(torch.where(behind > 0, behind, outside(centres, each)))
    least = torch.cat(distances).min(0).values
    return (least.clamp_max(limit) if limit else least).mean()


def outside(centres: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "views n"]:
    """How far each projection lies outside each picture, in half picture sizes; 0 inside."""
    size = centres.new_tensor([cameras.width, cameras.height])
    return ((2 * projected(centres, cameras) / size - 1).abs() - 1).clamp_min(0).sum(-1)


def projected(centres: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "views n 2"]:
    """Pixels of every centre in every view. A point behind a camera gets its mirrored projection."""
    local = torch.einsum("vij,nj->vni", cameras.w2c[:, :3, :3], centres) + cameras.w2c[:, None, :3, 3]
    image = torch.einsum("vij,vnj->vni", cameras.K, local)
    # The gradient of a division by (nearly) 0 is NaN even where `where` discards the result.
    in_plane = image[..., 2:].abs() < PLANE_Z
    pixels = image[..., :2] / torch.where(in_plane, 1.0, image[..., 2:])
    return torch.where(in_plane, PIXEL_AT_INFINITY * image[..., :2].detach().sign(), pixels)
