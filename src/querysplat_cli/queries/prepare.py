"""From the encoder's features to what the decoders read."""

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories, attended_rows
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.queries.coverage import AnchorReport
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.refine import refined
from querysplat_cli.queries.rendering_error import with_rendering_error
from querysplat_cli.runtime.choices import Target
from querysplat_cli.runtime.device import to_device

CPU = torch.device("cpu")
NOT_KNOWN = torch.zeros(0, 0, 0, dtype=torch.bool)
"""`MemoryMap.confirmed` where the encoder has no confidence."""
FARTHEST = 6e4
"""Depth is stored in half precision, whose largest number is a little larger."""


@dataclass(frozen=True)
class MemoryMap:
    """Where in the photos the rows of the memories come from, and the VGM's depth (empty if there is none).

    Rows are counted among all tokens of all views; `grid` is (special tokens, rows, columns) of a view's tokens.
    `confirmed` marks the depth that other views agree with (empty if that is not known).
    """

    geometry_rows: Int[Tensor, "geometry"]
    appearance_rows: Int[Tensor, "appearance"]
    grid: Int[Tensor, "3"]
    depth: Float[Tensor, "views height width"]
    confirmed: Bool[Tensor, "confirmed rows columns"]

    @property
    def layout(self) -> tuple[int, int, int]:
        special, rows, columns = self.grid.tolist()
        return special, rows, columns


@dataclass(frozen=True)
class PreparedQueries:
    """The variables of test-time optimisation, the anchors if queries are anchored, and where the rows come from."""

    variables: Memories | Features
    anchors: Anchors | None
    anchor_report: AnchorReport | None
    map: MemoryMap


def without_rows(prepared: PreparedQueries, memories: Memories) -> PreparedQueries:
    """Queries of the same model that have no row at all, with no memory to read."""
    where = prepared.map
    nothing = _no_rows(where.geometry_rows), _no_rows(where.appearance_rows)
    layout = MemoryMap(*nothing, where.grid.clone(), torch.zeros(0, 0, 0), NOT_KNOWN.clone())
    return PreparedQueries(_no_rows(memories), _no_rows(prepared.anchors), None, layout)


def _no_rows(part: Any) -> Any:
    """`part` with no row of any tensor in it. A part that is no copy would keep the whole in memory and in files."""
    if isinstance(part, Tensor):
        return part[:0].detach().clone()
    if part is None:
        return None
    return replace(part, **{field.name: _no_rows(getattr(part, field.name)) for field in fields(part)})


@torch.no_grad()
def prepare(
    model: QuerySplat,
    posed: PosedViews,
    geometry: Geometry,
    *,
    queries: int | None,
    soft_query_limit: int | None = None,
    target: Target,
    keep_all: bool = False,
) -> PreparedQueries:
    """Memories or features on the CPU; with anchors, only the rows that some anchor attends to, and rounds of feedback.

    `queries`, `soft_query_limit` and `keep_all` are those of `build_anchors`. Raises QuerySplatError when the model
    cannot read such features.
    """
    views, cameras = posed.views, posed.cameras
    model.check_features(geometry.features, cameras.height, cameras.width)
    device = next(model.parameters()).device
    features = model.embed(*to_device((geometry.features, views.images, cameras), device))
    anchors = report = None
    rows = torch.arange(len(features.geometry)), torch.arange(len(features.appearance))
    if model.config.queries == "anchored":
        anchors, report = build_anchors(
            views,
            cameras,
            geometry,
            queries=queries,
            soft_query_limit=soft_query_limit,
            keep_all=keep_all,
        )
        anchors = with_rendering_error(anchors, views, cameras)
        features, anchors, rows = attended_rows(features, anchors)
    memories = to_device(model.keys_and_values(features), CPU)
    if anchors is not None:
        anchors = refined(model, memories, anchors, views, cameras, geometry)
    variables: Memories | Features = memories if target != "features" else to_device(features, CPU)
    return PreparedQueries(variables, anchors, report, _memory_map(rows, geometry, cameras.height, cameras.width))


def _memory_map(
    rows: tuple[Int[Tensor, "geometry"], Int[Tensor, "appearance"]], geometry: Geometry, height: int, width: int
) -> MemoryMap:
    grid = height // geometry.patch, width // geometry.patch
    special = geometry.features[-1].shape[1] - grid[0] * grid[1]
    depth = torch.zeros(0, 0, 0) if geometry.depth is None else geometry.depth
    sure = geometry.confidence
    return MemoryMap(
        rows[0].int(),
        rows[1].int(),
        torch.tensor([special, *grid]).int(),
        depth.clamp_max(FARTHEST).half(),
        NOT_KNOWN.clone() if sure is None else sure > QUERY_POLICY.confident,
    )
