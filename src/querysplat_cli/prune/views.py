"""Views that the others make superfluous."""

from collections.abc import Sequence

import torch
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras, project_points

STILL = 0.004
"""Share of the picture's width that the scene's points must move by, in the median, from one view to another."""
COMMON = 0.5
"""Share of a view's points that the other must see for the two to show the same."""


def near_duplicates(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor]) -> dict[int, int]:
    """The views that show what an earlier one shows from nearly the same place: {view: that earlier view}.

    `points` [n, 3] are in world coordinates, `visibility` is for each view the numbers of those that it sees.
    """
    found: dict[int, int] = {}
    for view in range(len(cameras)):
        for other in range(view):
            if other not in found and _same(cameras, points, visibility, view, other):
                found[view] = other
                break
    return found


def _same(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor], view: int, other: int) -> bool:
    shared = visibility[view][torch.isin(visibility[view], visibility[other])]
    if not len(shared) or len(shared) < COMMON * len(visibility[view]):
        return False
    here, there = (project_points(points[shared], cameras.w2c[each], cameras.K[each]) for each in (view, other))
    return float((here - there).norm(dim=1).median()) < STILL * cameras.width
