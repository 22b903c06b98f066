"""Which blocks show something that the blocks of other views do not, and which contradict other views."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.cells import CELLS, Cells, from_blocks, to_blocks
from querysplat_cli.queries.compiled_comparison import compare_cells, mark_covered
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras, nearest_first
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
    shape, policy = cells.depth.shape, QUERY_POLICY
    # The nearest "other" view is mostly the view itself, which is passed over.
    others = nearest_first(cameras.centres)[:, : policy.compared_views + 1]
    counts, colours = torch.zeros(*shape, 2), torch.cat([cells.colour, torch.ones(*shape, 1)], -1)
    read = cells.point.flatten(1, -2), others, cameras.w2c, torch.stack(cameras.intrinsics, 1)
    limits = NEAREST_DEPTH, policy.depth_agreement, policy.free_space, policy.confident
    shown = depth, confidence, views.masks, views.images
    compare_cells(
        *(part.contiguous().numpy() for part in read),
        limits,
        *(part.contiguous().numpy() for part in shown),
        counts.flatten(1, -2).numpy(),
        colours.flatten(1, -2).numpy(),
    )
    supporters, hidden = counts.unbind(-1)
    hiding = hidden > supporters + cells.confidence
    return ViewComparison(hiding, colours[..., :3] / colours[..., 3:], supporters, hidden)


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
        earlier = [part[:own].flatten(0, 2) for part in (cells.point, cells.footprint, keep)]
        covered = _covered(cells, cameras, own, cell, *earlier)
        keep[own] = wanted[own] & (covered.float().mean(-1) < QUERY_POLICY.covered)
    return keep


def _covered(
    cells: Cells,
    cameras: Cameras,
    own: int,
    cell: int,
    points: Float[Tensor, "blocks cells 3"],
    footprint: Float[Tensor, "blocks cells"],
    keep: Bool[Tensor, "blocks"],
) -> Bool[Tensor, "rows columns cells"]:
    """Which cells of a view show a surface that a cell of a block in `keep` covers, one that is about as fine."""
    depth, size = (from_blocks(part[own]).contiguous() for part in (cells.depth, cells.footprint))
    hits = torch.zeros_like(depth)
    lens = torch.stack([part[own] for part in cameras.intrinsics])
    limits = NEAREST_DEPTH, QUERY_POLICY.depth_agreement, QUERY_POLICY.coarser
    blocks = (part.numpy() for part in (points, footprint, keep, cameras.w2c[own], lens))
    mark_covered(*blocks, limits, cell, depth.numpy(), size.numpy(), hits.numpy())
    # Points that are a little coarser than the cells leave gaps between them, so a neighbour's hit counts, too.
    near = F.max_pool2d(hits[None, None], 3, 1, 1)[0, 0]
    return to_blocks(near[None])[0] > 0
