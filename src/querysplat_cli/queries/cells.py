"""The pictures cut into cells: for each cell its place in space, its colour and its depth.

3 × 3 cells make a block. A block becomes one anchored query, and each of its cells one prior Gaussian.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.rotations import matrix_to_quaternion
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.scene.views import Views

CELLS = 3
"""Cells along a block's side, fixed by the checkpoint: a query owns CELLS² Gaussians."""


@dataclass(frozen=True)
class Cells(TensorDataclass):
    """The cells of every block of every view, [views, rows, columns, 9, …], or of chosen blocks, [blocks, 9, …].

    Points, footprints (a cell's side at its depth), tangents and origins (camera centres) are in scene units;
    `depth` is camera z.
    """

    point: Float[Tensor, "*blocks cells 3"]
    depth: Float[Tensor, "*blocks cells"]
    footprint: Float[Tensor, "*blocks cells"]
    confidence: Float[Tensor, "*blocks cells"]
    colour: Float[Tensor, "*blocks cells 3"]
    valid: Bool[Tensor, "*blocks cells"]
    along_x: Float[Tensor, "*blocks cells 3"]
    along_y: Float[Tensor, "*blocks cells 3"]
    normal: Float[Tensor, "*blocks cells 3"]
    origin: Float[Tensor, "*blocks cells 3"]

    def joined(self, other: "Cells") -> "Cells":
        """These blocks, then those of `other`."""
        return Cells(**{name: torch.cat([part, getattr(other, name)]) for name, part in self.named().items()})


def measure_cells(
    views: Views,
    cameras: Cameras,
    depth: Float[Tensor, "views height width"],
    confidence: Float[Tensor, "views height width"],
    cell: int,
) -> Cells:
    """The cells, `cell` pixels a side, of every block. The last blocks may reach beyond the canvas."""
    block = cell * CELLS
    # The median stays on one side of a depth edge. A mean would lie in the empty space between both sides.
    z = _windows(depth, cell, block).median(-1).values
    shown = views.masks[:, None].float()
    trust, share = (_means(part, cell, block)[:, 0] for part in (confidence[:, None], shown))
    weight = shown.clamp_min(1e-6)
    colour = (_means(views.images * weight, cell, block) / _means(weight, cell, block)).movedim(1, -1)
    _, rows, columns = z.shape
    u = (torch.arange(columns) + 0.5) * cell
    v = (torch.arange(rows) + 0.5) * cell
    fx, fy, cx, cy = (part[:, None, None] for part in cameras.intrinsics)
    c2w = cameras.c2w
    directions = torch.stack([(u - cx) / fx + 0 * z, (v[:, None] - cy) / fy + 0 * z, torch.ones_like(z)], -1)
    rotated = torch.einsum("vij,vrcj->vrci", c2w[:, :3, :3], directions)
    origin = c2w[:, None, None, :3, 3].expand_as(rotated)
    point = origin + z[..., None] * rotated
    footprint = z * cell / (fx * fy).sqrt()
    tangents = _tangents(point, footprint, c2w)
    return Cells(*map(to_blocks, (point, z, footprint, trust, colour, share > 0.5, *tangents, origin)))


def to_blocks(grid: Tensor) -> Tensor:
    """[V, rows·3, columns·3, …] → [V, rows, columns, 9, …]."""
    views, height, width = grid.shape[:3]
    split = grid.reshape(views, height // CELLS, CELLS, width // CELLS, CELLS, *grid.shape[3:])
    return split.transpose(2, 3).flatten(3, 4)


def from_blocks(blocks: Tensor) -> Tensor:
    """[rows, columns, 9] → [rows·3, columns·3]."""
    rows, columns, _ = blocks.shape
    return blocks.reshape(rows, columns, CELLS, CELLS).transpose(1, 2).reshape(rows * CELLS, columns * CELLS)


def discs(
    cells: Cells,
) -> tuple[
    Float[Tensor, "blocks cells 3"],
    Float[Tensor, "blocks cells 3"],
    Float[Tensor, "blocks cells 4"],
]:
    """Means, scales and quaternions of a thin disc on the surface for each cell."""
    length_x = cells.along_x.norm(dim=-1, keepdim=True)
    axis_x = cells.along_x / length_x
    axis_y = torch.linalg.cross(cells.normal, axis_x)
    length_y = (cells.along_y * axis_y).sum(-1, keepdim=True).abs()
    rotation = torch.stack([axis_x, axis_y, cells.normal], -1)
    fill, thickness = QUERY_POLICY.fill, QUERY_POLICY.thickness
    scales = torch.cat([fill * length_x, fill * length_y, thickness * cells.footprint[..., None]], -1)
    return cells.point, scales, matrix_to_quaternion(rotation)


def _windows(maps: Tensor, cell: int, block: int) -> Tensor:
    """[V, H, W] → the pixels of each cell: [V, H/cell, W/cell, cell²], edges repeated up to whole blocks."""
    padded = _in_whole_blocks(maps[:, None], block)[:, 0]
    views = len(maps)
    rows, columns = padded.shape[1] // cell, padded.shape[2] // cell
    return padded.reshape(views, rows, cell, columns, cell).transpose(2, 3).flatten(3)


def _means(maps: Tensor, cell: int, block: int) -> Tensor:
    """[V, C, H, W] → the mean of each cell: [V, C, H/cell, W/cell], edges repeated up to whole blocks."""
    return F.avg_pool2d(_in_whole_blocks(maps, block), cell)


def _in_whole_blocks(maps: Float[Tensor, "views channels height width"], block: int) -> Tensor:
    """The last row and column repeated until the sides are multiples of `block`."""
    pad = (0, -maps.shape[3] % block, 0, -maps.shape[2] % block)
    return F.pad(maps, pad, mode="replicate") if any(pad) else maps


def _tangents(point: Tensor, footprint: Tensor, c2w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Steps on the surface to the next cell right and below, and the unit normal towards the camera.

    Across a depth edge, or where the camera sees the surface at a grazing angle, these steps are unreliable.
    There the disc faces the camera.
    """
    along_x = torch.gradient(point, dim=2)[0]
    along_y = torch.gradient(point, dim=1)[0]
    facing_x = c2w[:, None, None, :3, 0] * footprint[..., None]
    facing_y = c2w[:, None, None, :3, 1] * footprint[..., None]
    limit = 3 * footprint[..., None]
    steep = (along_x.norm(dim=-1, keepdim=True) > limit) | (along_y.norm(dim=-1, keepdim=True) > limit)
    along_x = torch.where(steep, facing_x, along_x)
    along_y = torch.where(steep, facing_y, along_y)
    normal = F.normalize(torch.linalg.cross(along_y, along_x), dim=-1)
    return along_x, along_y, normal
