"""Near-duplicate views."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras, project_points
from querysplat_cli.scene.sparse_points import shared_points


def near_duplicates(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor]) -> dict[int, int]:
    """The views that show what an earlier one shows from nearly the same place: {view: that earlier view}.

    `points` [n, 3] are in world coordinates, `visibility` is for each view the row numbers of the points that it sees.
    """
    common = shared_points(visibility, len(points))
    found: dict[int, int] = {}
    for view, rows in enumerate(visibility):
        row = common[[view]]
        for other in np.sort(row.indices[row.data >= PRUNE_POLICY.duplicate_overlap * len(rows)]).tolist():
            if other < view and other not in found and _near(cameras, points, visibility, view, other):
                found[view] = other
                break
    return found


def _near(cameras: Cameras, points: Tensor, visibility: Sequence[Tensor], view: int, other: int) -> bool:
    """Whether the points that both views see lie nearly at the same pixels of both."""
    shared = visibility[view][torch.isin(visibility[view], visibility[other])]
    here, there = (project_points(points[shared], cameras.w2c[each], cameras.K[each]) for each in (view, other))
    return float((here - there).norm(dim=1).median()) < PRUNE_POLICY.duplicate_shift * cameras.width
