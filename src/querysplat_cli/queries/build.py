"""Anchors of queries: points spread over the VGM's depth maps, with a prior Gaussian for each cell.

The pictures are cut into square blocks, one query each, and every block into 3 × 3 cells, one Gaussian each. Blocks
that other views' blocks cover, or that other views contradict, carry no query. Coarser blocks extend the photos beyond
their borders, where no photo shows anything.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.anchors import Anchors, Neighbours, Reading
from querysplat_cli.queries.backdrop import shows_background
from querysplat_cli.queries.cells import CELLS, Cells, discs, measure_cells
from querysplat_cli.queries.coverage import AnchorReport, ViewComparison, choose_blocks, compare_views
from querysplat_cli.queries.features import border_features, photo_features
from querysplat_cli.queries.outpaint import border_blocks
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views


def build_anchors(
    views: Views,
    cameras: Cameras,
    geometry: Geometry,
    *,
    queries: int | None = None,
    soft_query_limit: int | None = None,
    keep_all: bool = False,
) -> tuple[Anchors, AnchorReport]:
    """Anchored queries for a scene whose `geometry` has depth and confidence.

    Memory rows are the patches of `geometry.patch` pixels, view by view, row by row. Each query attends to the rows
    that are nearest to it in space. By default a block of the finest size becomes a query when it shows something
    that no earlier view's block covers; with `keep_all`, every block does.

    `queries` is a limit for all queries: pictures are cut more coarsely until the blocks in the photos fit, and blocks
    beyond the borders, which come last, fill what is left. `soft_query_limit` is a limit for the queries in the photos
    only, and applies without `queries`; it is exceeded when one block a photo is still too many. Raises
    QuerySplatError when photos that show different things are more than `queries`, and when masks leave no block.
    """
    assert geometry.depth is not None
    assert geometry.confidence is not None
    depth = _whole(geometry.depth)
    limit = _Limit(soft_query_limit if queries is None else queries, strict=queries is not None)
    chosen = _cut(views, cameras, depth, geometry.confidence, limit, keep_all)
    keep, side = chosen.keep, chosen.report.side
    if not keep.any():
        raise QuerySplatError("the masks hide nearly all of every photo", "White in a mask is what takes part.")
    features = photo_features(chosen.cells, chosen.comparison)[keep]
    cells = replace(chosen.cells, colour=chosen.comparison.colour).map(lambda part: part[keep])
    if shows_background(views):
        border = border_blocks(views, cameras, depth, QUERY_POLICY.border_coarser * (side // CELLS))
        if queries is not None:
            border = border.map(lambda part: part[: queries - chosen.report.kept])
        features, cells = torch.cat([features, border_features(border)]), cells.joined(border)
    anchors = _anchors(cells, features, cameras.patch_places(depth, geometry.patch).reshape(-1, 3))
    return anchors, replace(chosen.report, beyond=len(cells.point) - chosen.report.kept)


def _whole(depth: Float[Tensor, "views height width"]) -> Float[Tensor, "views height width"]:
    """Depth that is positive everywhere: where it is not, outside of masks, that of the nearest pixel.

    Blocks at the border of a mask read it as well.
    """
    usable = depth.isfinite() & (depth > 0)
    if usable.all():
        return depth
    filled = depth.clone()
    for view, there in enumerate(usable):
        if there.any():
            nearest = distance_transform_edt(~there.numpy(), return_distances=False, return_indices=True)
            filled[view] = depth[view][tuple(torch.from_numpy(nearest).long())]
    return filled.where(filled.isfinite() & (filled > 0), 1.0)


@dataclass(frozen=True)
class _Limit:
    """At most `count` queries in the photos, or None for any number; a strict limit cannot be exceeded."""

    count: int | None
    strict: bool


@dataclass(frozen=True)
class _Chosen:
    """All blocks of the pictures at one size, and which of them become queries."""

    cells: Cells
    comparison: ViewComparison
    keep: Bool[Tensor, "views rows columns"]
    report: AnchorReport


def _cut(views: Views, cameras: Cameras, depth: Tensor, confidence: Tensor, limit: _Limit, keep_all: bool) -> _Chosen:
    """The finest blocks that keep the limit.

    What share of the blocks become queries hardly depends on their size, and rises a little where they are finer. So
    sizes are tried from coarse to fine, without those that the share of a coarser one rules out.
    """
    cut = partial(_cut_into, views, cameras, depth, confidence, keep_all=keep_all)
    finest, longest = QUERY_POLICY.finest_cell, max(cameras.height, cameras.width)
    if limit.count is None:
        return cut(finest)
    best: _Chosen | None = None
    share = 1.0
    while True:
        cell = finest
        while share * _block_count(cameras, cell) > limit.count and cell * CELLS < longest:
            cell += 1
        if best and cell * CELLS >= best.report.side:
            return best
        tried = cut(cell)
        share = tried.report.kept / tried.report.blocks
        if tried.report.kept <= limit.count:
            best = tried
        elif cell * CELLS < longest:
            finest = cell + 1
        elif limit.strict:
            raise QuerySplatError(
                f"--queries {limit.count}: these photos need {tried.report.kept}, even one for a whole photo",
                "Ask for more.",
            )
        else:
            return tried


def _cut_into(
    views: Views, cameras: Cameras, depth: Tensor, confidence: Tensor, cell: int, *, keep_all: bool
) -> _Chosen:
    """Blocks of cells of `cell` pixels."""
    cells = measure_cells(views, cameras, depth, confidence, cell)
    comparison = compare_views(cells, views, cameras, depth, confidence)
    return _Chosen(cells, comparison, *choose_blocks(cells, comparison, cameras, cell, keep_all))


def _block_count(cameras: Cameras, cell: int) -> int:
    """How many blocks the pictures have together."""
    side = cell * CELLS
    return len(cameras) * -(-cameras.height // side) * -(-cameras.width // side)


def _anchors(cells: Cells, features: Float[Tensor, "queries channels"], patches: Float[Tensor, "rows 3"]) -> Anchors:
    """An anchor for each of the chosen blocks; `patches` are the places of the memory rows."""
    means, scales, quats = discs(cells)
    spacing = (cells.footprint * CELLS).mean(1)
    centres = means[:, CELLS**2 // 2]
    memory = _neighbours(centres, spacing, patches)
    guessed, measured = QUERY_POLICY.guessed_opacity, QUERY_POLICY.measured_opacity
    opacities = guessed + (measured - guessed) * cells.confidence
    return Anchors(
        means=means,
        scales=scales,
        quats=quats,
        opacities=torch.where(cells.valid, opacities, QUERY_POLICY.masked_opacity),
        colours=cells.colour,
        spacing=spacing,
        features=features,
        geometry=memory,
        appearance=memory,
        queries=_neighbours(centres, spacing, centres),
        refinement=means.new_zeros(*means.shape[:2], 0),
        reading=Reading.none(len(means)),
    )


def _neighbours(
    points: Float[Tensor, "queries 3"], spacing: Float[Tensor, "queries"], rows: Float[Tensor, "rows 3"]
) -> Neighbours:
    """The nearest rows of each point, and a penalty on their distance."""
    near = min(QUERY_POLICY.neighbours, len(rows))
    distance, index = cKDTree(rows.double().numpy()).query(points.double().numpy(), k=near)
    relative = torch.from_numpy(distance.reshape(len(points), -1)).to(spacing.dtype) / spacing[:, None]
    bias = -QUERY_POLICY.distance_penalty * relative.square().clamp_max(4)
    return Neighbours(torch.from_numpy(index.reshape(len(points), -1)), bias)
