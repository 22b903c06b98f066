"""The visibility loss of TokenGS (paper, section 3.3; spec, section 13): Gaussians that no view sees are drawn in."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras

FAR_AWAY = 1e6
"""Pixels: where a point in the plane of a camera is taken to be."""
FLAT = 1e-12
"""Camera z below which a point counts as in the plane."""


def projected(centres: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "views n 2"]:
    """Pixels of every centre in every view. Points behind a camera are projected as they are."""
    local = torch.einsum("vij,nj->vni", cameras.w2c[:, :3, :3], centres) + cameras.w2c[:, None, :3, 3]
    image = torch.einsum("vij,vnj->vni", cameras.K, local)
    # A division by (nearly) nothing would send NaN back, whatever becomes of its result.
    flat = image[..., 2:].abs() < FLAT
    pixels = image[..., :2] / torch.where(flat, 1.0, image[..., 2:])
    return torch.where(flat, FAR_AWAY * image[..., :2].detach().sign(), pixels)


def visibility_loss(centres: Float[Tensor, "n 3"], cameras: Cameras, threshold: float = 1.0) -> Float[Tensor, ""]:
    """How far each centre is outside the picture that it is least outside of, in half pictures; the mean.

    Beyond `threshold` a centre counts as that and gets no gradient; 0 counts every distance. A point behind a
    camera may count as inside, where its mirrored projection is.
    """
    size = centres.new_tensor([cameras.width, cameras.height])
    outside = ((2 * projected(centres, cameras) / size - 1).abs() - 1).clamp_min(0).sum(-1)
    least = outside.min(0).values
    return (least.clamp_max(threshold) if threshold else least).mean()
