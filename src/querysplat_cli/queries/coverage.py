"""Which blocks show something that the blocks of other views do not, and which contradict other views."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.cells import CELLS, Cells, from_blocks, to_blocks
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras
from querysplat_cli.scene.views import Views


@dataclass(frozen=True)
class AnchorReport:
    """How many blocks of `side` pixels the pictures have, and why some carry no query.

    `redundant` blocks show what another view's blocks cover, `hiding` ones are in front of surfaces that other views
    measured, `empty` ones lie outside the mask. `beyond` counts the queries outside all photos.
    """

    blocks: int
    kept: int
    redundant: int
    hiding: int
    empty: int
    beyond: int = 0
    side: int = CELLS * QUERY_POLICY.finest_cell


@dataclass(frozen=True)
class ViewComparison:
    """Each cell compared with the other views.

    `supporters` is the summed confidence of the views that see the same surface there; `hidden` counts the views
    whose measured surface the cell would hide; `hiding` is whether more is hidden than supports the cell; `colour`
    is the mean over the own view and its supporters, weighted by confidence.
    """

    hiding: Bool[Tensor, "*blocks cells"]
    colour: Float[Tensor, "*blocks cells 3"]
    supporters: Float[Tensor, "*blocks cells"]
    hidden: Float[Tensor, "*blocks cells"]


def compare_views(
    cells: Cells,
    views: Views,
    cameras: Cameras,
    depth: Float[Tensor, "views height width"],
    confidence: Float[Tensor, "views height width"],
) -> ViewComparison:
    """Project the cells of each view into its nearest other views, and compare depth and colour there."""
    distance = torch.cdist(cameras.centres, cameras.centres)
    shape = cells.depth.shape
    supporters = torch.zeros(shape)
    hidden = torch.zeros(shape)
    colour = cells.colour.clone()
    weight = torch.ones(shape)
    for own in range(len(views)):
        points = cells.point[own].reshape(-1, 3)
        for other in distance[own].argsort(stable=True)[: QUERY_POLICY.compared_views + 1].tolist():
            if other == own:
                continue
            inside, row, column, z = find_pixels(points, other, views, cameras)
            surface = depth[other, row, column]
            same = inside & ((z / surface - 1).abs() < QUERY_POLICY.depth_agreement)
            sure = confidence[other, row, column]
            in_front = inside & (z < surface * (1 - QUERY_POLICY.free_space)) & (sure > QUERY_POLICY.confident)
            share = (same * sure).reshape(shape[1:])
            supporters[own] += share
            hidden[own] += in_front.reshape(shape[1:])
            sample = views.images[other][:, row, column].T.reshape(*shape[1:], 3)
            colour[own] += share[..., None] * sample
            weight[own] += share
    hiding = hidden > supporters + cells.confidence
    return ViewComparison(hiding, colour / weight[..., None], supporters, hidden)


def find_pixels(
    points: Float[Tensor, "n 3"], view: int, views: Views, cameras: Cameras
) -> tuple[Bool[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Whether points fall on the photo, occluded or not; the row and column of their pixel, and camera z."""
    x, y, z = cameras.project(points, view)
    inside = (z > NEAREST_DEPTH) & (x >= 0) & (y >= 0) & (x < cameras.width) & (y < cameras.height)
    column = x.clamp(0, cameras.width - 1).long()
    row = y.clamp(0, cameras.height - 1).long()
    return inside & views.masks[view, row, column], row, column, z.clamp_min(NEAREST_DEPTH)


def choose_blocks(
    cells: Cells, comparison: ViewComparison, cameras: Cameras, cell: int, keep_all: bool
) -> tuple[Bool[Tensor, "views rows columns"], AnchorReport]:
    """Which blocks become queries; with `keep_all` every block inside the mask."""
    empty = cells.valid.float().mean(-1) <= 0.5
    if keep_all:
        shown = int((~empty).sum())
        return ~empty, AnchorReport(empty.numel(), shown, 0, 0, empty.numel() - shown, side=cell * CELLS)
    hiding = ~empty & (comparison.hiding.float().mean(-1) > 0.5)
    keep = uncovered(cells, ~empty & ~hiding, cameras, cell)
    redundant = ~empty & ~hiding & ~keep
    report = AnchorReport(
        blocks=keep.numel(),
        kept=int(keep.sum()),
        redundant=int(redundant.sum()),
        hiding=int(hiding.sum()),
        empty=int(empty.sum()),
        side=cell * CELLS,
    )
    return keep, report


def uncovered(
    cells: Cells, wanted: Bool[Tensor, "views rows columns"], cameras: Cameras, cell: int
) -> Bool[Tensor, "views rows columns"]:
    """The wanted blocks that the blocks kept of earlier views do not cover. Views are taken in their order."""
    keep = torch.zeros_like(wanted)
    for own in range(len(cameras)):
        points, footprint = cells.point[keep].reshape(-1, 3), cells.footprint[keep].reshape(-1)
        covered = _covered(cells, cameras, own, cell, points, footprint)
        keep[own] = wanted[own] & (covered.float().mean(-1) < QUERY_POLICY.covered)
    return keep


def _covered(
    cells: Cells,
    cameras: Cameras,
    own: int,
    cell: int,
    points: Float[Tensor, "n 3"],
    footprint: Float[Tensor, "n"],
) -> Bool[Tensor, "rows columns cells"]:
    """Which cells of a view show a surface that one of `points` covers, from a cell that is about as fine."""
    x, y, z = cameras.project(points, own)
    depth, size = (from_blocks(part[own]) for part in (cells.depth, cells.footprint))
    column = torch.floor(x / cell).clamp(-1, depth.shape[1]).long()
    row = torch.floor(y / cell).clamp(-1, depth.shape[0]).long()
    inside = (z > NEAREST_DEPTH) & (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    z, row, column, footprint = z[inside], row[inside], column[inside], footprint[inside]
    same = (z / depth[row, column] - 1).abs() < QUERY_POLICY.depth_agreement
    same &= footprint < QUERY_POLICY.coarser * size[row, column]
    hits = torch.zeros_like(depth)
    hits[row[same], column[same]] = 1
    # Points that are a little coarser than the cells leave gaps between them, so a neighbour's hit counts, too.
    near = F.max_pool2d(hits[None, None], 3, 1, 1)[0, 0]
    return to_blocks(near[None])[0] > 0
