"""Blocks outside all photos: the pictures are extended beyond their borders."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.cells import CELLS, Cells, measure_cells
from querysplat_cli.queries.coverage import uncovered
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.find_pixels import find_pixels
from querysplat_cli.scene.views import Views


def border_blocks(views: Views, cameras: Cameras, depth: Float[Tensor, "views height width"], cell: int) -> Cells:
    """Blocks, of cells of `cell` pixels, around each photo where no other photo shows anything: [blocks, 9, …]."""
    block = cell * CELLS
    margin = block * math.ceil(QUERY_POLICY.border * max(depth.shape[1:]) / block)
    around = extend_borders(views, cameras, depth, cell=cell, margin=margin)
    cells = measure_cells(around.views, around.cameras, around.depth, torch.zeros_like(around.depth), 1)
    wanted = cells.valid.float().mean(-1) > 0.5
    points = cells.point[wanted].reshape(-1, 3)
    seen = torch.zeros(len(points), dtype=torch.bool)
    for view in range(len(views)):
        seen |= find_pixels(points, view, views, cameras)[0]
    wanted[wanted.clone()] = seen.reshape(-1, CELLS**2).float().mean(1) <= 0.5
    keep = uncovered(cells, wanted, around.cameras, 1)
    return cells.map(lambda part: part[keep])


@dataclass(frozen=True)
class ExtendedBorders:
    """The views at a fraction of their size on a larger canvas; masks are True *outside* the photos only.

    What the user masked inside a photo is no border.
    """

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
    for image, z, mask, (height, width) in zip(views.images, depth, views.masks, views.sizes, strict=True):
        mean = _shares(torch.cat([image, 1 / z[None]]), mask, cell, ring)
        beyond = _shares(image, _rectangle(mask, height, width), cell, ring)[-1] <= 0.5
        inside = mean[-1] > 0.5
        distance, (row, column) = distance_transform_edt(~inside.numpy(), return_indices=True)
        spread = mean[:, torch.from_numpy(row).long(), torch.from_numpy(column).long()]
        pictures.append(spread[:-1] / spread[-1])
        masks.append(torch.from_numpy((distance > 0) & (distance <= ring)) & beyond & inside.any())
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


def _rectangle(mask: Bool[Tensor, "rows columns"], height: int, width: int) -> Bool[Tensor, "rows columns"]:
    """Where the photo lies on the canvas: the mask itself, or the whole picture where the user masked parts of it."""
    box = torch.zeros_like(mask)
    if mask.any():
        rows, columns = (mask.any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
        box[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    if not mask.equal(box):
        box[:height, :width] = True
    return box


def _shares(
    picture: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"], cell: int, ring: int
) -> Float[Tensor, "channels+1 rows columns"]:
    """For each cell, the sums over its pixels inside the mask divided by cell², with a ring of zeros around.

    The last channel is the share of the cell that lies inside the mask.
    """
    height, width = mask.shape
    weighted = torch.where(mask, torch.cat([picture, torch.ones(1, height, width)]), 0)
    whole = F.pad(weighted, (0, -width % cell, 0, -height % cell))
    return F.pad(F.avg_pool2d(whole[None], cell)[0], (ring,) * 4)
