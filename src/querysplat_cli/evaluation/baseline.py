"""The baseline: one Gaussian for each small block of pixels, at the VGM's depth."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Views


def back_project(
    views: Views, cameras: Cameras, depth: Float[Tensor, "views height width"], stride: int = 2
) -> Gaussians:
    """One round Gaussian for every `stride` × `stride` pixels of every view, coloured as the photo.

    Nothing is merged, learned or optimised. Standard deviation is 0.6 of the distance between neighbours.
    """
    z = torch.nn.functional.avg_pool2d(depth[:, None], stride)[:, 0]
    colour = torch.nn.functional.avg_pool2d(views.images, stride).permute(0, 2, 3, 1)
    inside = torch.nn.functional.avg_pool2d(views.masks[:, None].float(), stride)[:, 0] > 0.5
    rows, columns = ((torch.arange(size) + 0.5) * stride for size in z.shape[1:])
    means = cameras.unproject(z, columns, rows)
    fx, fy = (cameras.K[:, i, i, None, None] for i in (0, 1))
    scales = 0.6 * stride * z / (fx * fy).sqrt()
    count = int(inside.sum())
    return Gaussians(
        means=means[inside],
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        scales=scales[inside][:, None].expand(count, 3).contiguous(),
        opacities=torch.full((count,), 0.9),
        sh=((colour[inside] - 0.5) / SH_0)[:, None],
    )
