"""Regions become one scene: of each place, what its own region has there."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.pipeline.regions.scene import RegionScene
from querysplat_cli.queries.prepare import MemoryMap

UNREAD = -1e4
"""Bias of a row that fills up the list of a query's neighbours: it gets no attention."""


def merged_kept(scenes: Sequence[RegionScene], own: Sequence[Tensor]) -> Bool[Tensor, "n"] | None:
    """Which decoded Gaussians belong to the merged scene; `own` marks those of each region that stay.

    None where a region has no queries. Where the Gaussians of a region were optimised themselves, all that its own
    optimisation kept are marked.
    """
    found = []
    for scene, stays in zip(scenes, own, strict=True):
        if scene.anchors is None:
            return None
        count = scene.anchors.opacities.numel()
        kept = torch.ones(count, dtype=torch.bool) if scene.kept is None else scene.kept.clone()
        if int(kept.sum()) == len(stays):
            kept[kept.clone()] = stays
        found.append(kept)
    return torch.cat(found)


def merged_memories(scenes: Sequence[RegionScene]) -> Memories:
    """The rows of all memories, one region after another."""
    return Memories(**{each.name: _all(scenes, each.name) for each in fields(Memories)})


def _all(scenes: Sequence[RegionScene], name: str) -> Tensor:
    return torch.cat([getattr(scene.memories, name) for scene in scenes])


def merged_anchors(scenes: Sequence[RegionScene]) -> Anchors | None:
    """The queries of all regions, which read the rows of their own region's memories."""
    anchors = [scene.anchors for scene in scenes if scene.anchors is not None]
    if len(anchors) < len(scenes):
        return None
    rows = {
        "geometry": [len(scene.memories.geometry_keys) for scene in scenes],
        "appearance": [len(scene.memories.appearance_keys) for scene in scenes],
        "queries": [len(each) for each in anchors],
    }
    joint: dict[str, Any] = {}
    for field in fields(Anchors):
        parts = [getattr(each, field.name) for each in anchors]
        joint[field.name] = _neighbours(parts, rows[field.name]) if field.name in rows else torch.cat(parts)
    return Anchors(**joint)


def _neighbours(parts: Sequence[Neighbours], rows: Sequence[int]) -> Neighbours:
    near, first = max(part.index.shape[1] for part in parts), 0
    indices, biases = [], []
    for part, count in zip(parts, rows, strict=True):
        more = near - part.index.shape[1]
        indices.append(F.pad(part.index, (0, more)) + first)
        biases.append(F.pad(part.bias, (0, more), value=UNREAD))
        first += count
    return Neighbours(torch.cat(indices), torch.cat(biases))


def merged_map(groups: Sequence[Group], scenes: Sequence[RegionScene], views: int) -> MemoryMap:
    """Rows of the merged memories among the tokens of all views. The depth of a view is that of its own region."""
    special, rows, columns = scenes[0].map.layout
    first = scenes[0].map
    depth = first.depth.new_zeros(views, *first.depth.shape[1:]) if first.depth.numel() else first.depth
    geometry, appearance = [], []
    for group, scene in zip(groups, scenes, strict=True):
        place = torch.tensor(group.rows)
        geometry.append(_moved(scene.map.geometry_rows, special + rows * columns, place))
        appearance.append(_moved(scene.map.appearance_rows, rows * columns, place))
        if first.depth.numel():
            depth[list(group.core)] = scene.map.depth[: len(group.core)]
    return MemoryMap(torch.cat(geometry), torch.cat(appearance), first.grid, depth)


def _moved(rows: Int[Tensor, "n"], tokens: int, place: Int[Tensor, "views"]) -> Int[Tensor, "n"]:
    """`rows` among `tokens` of each view of a region, for views that are at `place` in the whole."""
    whole = rows.long()
    return (place[whole // tokens] * tokens + whole % tokens).int()
