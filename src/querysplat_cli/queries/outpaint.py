"""What may stand beside the photos, where none of them looks: their borders go on."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views


@dataclass(frozen=True)
class ExtendedBorders:
    """The views at a fraction of their size on a larger canvas; masks are True *beside* the photos only."""

    views: Views
    cameras: Cameras
    depth: Float[Tensor, "views rows columns"]


def extend_borders(
    views: Views, cameras: Cameras, depth: Float[Tensor, "views height width"], *, cell: int, margin: int
) -> ExtendedBorders:
    """Colour and inverse depth of the nearest pixels inside the mask, repeated over `margin` pixels around it.

    A pixel of the result is the mean of `cell` × `cell` pixels; `margin` is a multiple of `cell`.
    """
    ring = margin // cell
    pictures, masks = [], []
    for image, z, mask in zip(views.images, depth, views.masks, strict=True):
        mean = _shares(torch.cat([image, 1 / z[None]]), mask, cell, ring)
        inside = mean[-1] > 0.5
        distance, (row, column) = distance_transform_edt(~inside.numpy(), return_indices=True)
        spread = mean[:, torch.from_numpy(row).long(), torch.from_numpy(column).long()]
        pictures.append(spread[:-1] / spread[-1])
        masks.append(torch.from_numpy((distance > 0) & (distance <= ring)) & inside.any())
    colour, inverse = torch.stack(pictures).split((3, 1), 1)
    K = cameras.K.clone()
    K[:, :2] /= cell
    K[:, :2, 2] += ring
    rows, columns = inverse.shape[2:]
    sizes = ((rows, columns),) * len(views)
    return ExtendedBorders(
        replace(views, images=colour, masks=torch.stack(masks), sizes=sizes),
        replace(cameras, K=K, height=rows, width=columns),
        1 / inverse[:, 0],
    )


def _shares(
    picture: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"], cell: int, ring: int
) -> Float[Tensor, "channels+1 rows columns"]:
    """Sums over each cell's pixels inside the mask, over cell²; last the mask's share of it. A ring of zeros around."""
    height, width = mask.shape
    known = torch.where(mask, torch.cat([picture, torch.ones(1, height, width)]), 0)
    whole = F.pad(known, (0, -width % cell, 0, -height % cell))
    return F.pad(F.avg_pool2d(whole[None], cell)[0], (ring,) * 4)
