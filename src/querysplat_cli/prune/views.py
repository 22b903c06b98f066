"""Near-duplicate views, and a few views in place of all."""

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras, project_points

Item = TypeVar("Item")


def near_duplicates(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor]) -> dict[int, int]:
    """The views that show what an earlier one shows from nearly the same place: {view: that earlier view}.

    `points` [n, 3] are in world coordinates, `visibility` is for each view the row numbers of the points that it sees.
    """
    found: dict[int, int] = {}
    for view in range(len(cameras)):
        for other in range(view):
            if other not in found and _same(cameras, points, visibility, view, other):
                found[view] = other
                break
    return found


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """`count` of the items, the first and the last included; all where there are no more."""
    if count >= len(items):
        return list(items)
    step = (len(items) - 1) / max(count - 1, 1)
    return [items[round(i * step)] for i in range(count)]


def _same(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor], view: int, other: int) -> bool:
    shared = visibility[view][torch.isin(visibility[view], visibility[other])]
    if not len(shared) or len(shared) < PRUNE_POLICY.duplicate_overlap * len(visibility[view]):
        return False
    here, there = (project_points(points[shared], cameras.w2c[each], cameras.K[each]) for each in (view, other))
    return float((here - there).norm(dim=1).median()) < PRUNE_POLICY.duplicate_shift * cameras.width
