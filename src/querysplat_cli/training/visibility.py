"""The visibility loss (paper, section 3.4; taken over from TokenGS): it draws Gaussians into the images.

A Gaussian's loss is the distance of its projected centre from the nearest image, and zero inside any image. Without it,
a Gaussian that no target view sees would get no gradient from the picture losses.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras

PIXEL_AT_INFINITY = 1e6
"""Pixel coordinate that stands for the projection of a point in a camera's plane z = 0."""
PLANE_Z = 1e-12
"""A point whose camera z is nearer to 0 counts as in that plane."""


def projected(centres: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "views n 2"]:
    """Pixels of every centre in every view. A point behind a camera gets its mirrored projection."""
    local = torch.einsum("vij,nj->vni", cameras.w2c[:, :3, :3], centres) + cameras.w2c[:, None, :3, 3]
    image = torch.einsum("vij,vnj->vni", cameras.K, local)
    # The gradient of a division by (nearly) 0 is NaN even where `where` discards the result.
    in_plane = image[..., 2:].abs() < PLANE_Z
    pixels = image[..., :2] / torch.where(in_plane, 1.0, image[..., 2:])
    return torch.where(in_plane, PIXEL_AT_INFINITY * image[..., :2].detach().sign(), pixels)


def visibility_loss(centres: Float[Tensor, "n 3"], cameras: Cameras, threshold: float = 1.0) -> Float[Tensor, ""]:
    """Mean over the centres of the distance to the nearest image, in half image sizes (L1 over both axes).

    Distances above `threshold` count as `threshold` and have no gradient; a threshold of 0 means no limit. A centre
    behind a camera counts as inside when its mirrored projection is inside.
    """
    size = centres.new_tensor([cameras.width, cameras.height])
    outside = ((2 * projected(centres, cameras) / size - 1).abs() - 1).clamp_min(0).sum(-1)
    least = outside.min(0).values
    return (least.clamp_max(threshold) if threshold else least).mean()
