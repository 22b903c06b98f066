"""Which views are compared, and between which depths, from the sparse points."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.scene.cameras import nearest_first
from querysplat_cli.scene.sparse_points import shared_points


@dataclass(frozen=True)
class InverseRange:
    """The inverse depths to search between, and the median inverse depth of the points."""

    far: float
    near: float
    middle: float


def inverse_range(posed: PosedViews, view: int) -> InverseRange:
    """The range of the points that the view observes, with room in front of them and behind them.

    A view with few points takes those of all views. Without any points, everything is taken to be at depth 1.
    """
    z = _depths(posed, view, posed.visibility[view])
    policy = DEPTH_POLICY
    if len(z) < policy.few_own_points:
        z = np.concatenate([_depths(posed, v, rows) for v, rows in enumerate(posed.visibility)])
    if not len(z):
        return InverseRange(policy.farther_than_points, policy.nearer_than_points, 1.0)
    inverse = 1 / z
    farthest, middle, nearest = (float(p) for p in np.percentile(inverse, (1, 50, policy.nearest_point)))
    near, together = policy.nearer_than_points * nearest, _nearest_together(inverse)
    if together > near:  # a post in front of a house has a few points of thousands
        near = policy.nearer_than_points * together
    return InverseRange(policy.farther_than_points * farthest, near, middle)


def _nearest_together(inverse: np.ndarray) -> float:
    """The largest inverse depth from which on several points have nearly one depth; 0 without any."""
    falling = np.sort(inverse)[::-1]
    last = DEPTH_POLICY.points_together - 1
    starts = falling[: max(len(falling) - last, 0)]
    together = starts[DEPTH_POLICY.nearly_one_depth * falling[last:] >= starts]
    return float(together[0]) if len(together) else 0.0


def choose_sources(posed: PosedViews) -> list[list[int]]:
    """For each view, those that share most points with it at an angle that measures depth well, best first."""
    common = shared_points(posed.visibility, len(posed.points))
    centres = posed.cameras.centres.double()
    found = []
    for view in range(len(posed.visibility)):
        row = common[[view]]
        others = row.indices[row.data >= DEPTH_POLICY.fewest_shared_points].tolist()
        scored = [(_worth(posed, centres, view, other), other) for other in others if other != view]
        best = sorted((pair for pair in scored if pair[0]), key=lambda pair: (-pair[0], pair[1]))
        found.append([other for _, other in best[: DEPTH_POLICY.sources]])
    return found


def _worth(posed: PosedViews, centres: Tensor, view: int, other: int) -> float:
    """The number of points that both views see; less where the angle between them is bad, 0 where it is too small."""
    good, wide = DEPTH_POLICY.good_angles
    shared = posed.visibility[view][torch.isin(posed.visibility[view], posed.visibility[other])]
    points = posed.points[shared].double()
    one, two = points - centres[view], points - centres[other]
    # The arc cosine would lose small angles, because their cosine rounds to 1.
    angles = torch.atan2(torch.linalg.cross(one, two).norm(dim=1), (one * two).sum(1))
    angle = float(torch.rad2deg(angles).median())
    if angle <= DEPTH_POLICY.least_angle:
        return 0.0
    return len(shared) * min(angle / good, 1.0) * min(wide / angle, 1.0) ** 2


def nearest_views(posed: PosedViews) -> list[list[int]]:
    """For each view, the other views by the distance of their cameras, nearest first; a limited number of them."""
    order = nearest_first(posed.cameras.centres.double()).tolist()
    return [
        [other for other in row if other != view][: DEPTH_POLICY.free_space_views] for view, row in enumerate(order)
    ]


def _depths(posed: PosedViews, view: int, rows: torch.Tensor) -> np.ndarray:
    """Camera z of the points in these rows that lie in front of the camera."""
    w2c = posed.cameras.w2c[view].double()
    z = posed.points[rows].double() @ w2c[2, :3] + w2c[2, 3]
    return np.asarray(z[z > 0])
