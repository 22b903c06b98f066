"""Which views measure which, and between which depths: told by the sparse points."""

from dataclasses import dataclass

import numpy as np
import torch

from querysplat_cli.encoders.base import PosedViews

SOURCES = 4
COMPARED_VIEWS = 16
"""Free space is asked of this many nearest views, so that time stays linear in the views."""
FEW_POINTS = 8
"""With fewer points than this of its own a view borrows those of all."""
FEWEST_SHARED = 5
"""Views that share fewer points do not measure each other."""
ANGLES = (0.3, 6.0, 25.0)
"""Degrees between two views of a point: the least that measures anything, and the best range."""
BEFORE, BEHIND = 1.4, 0.2
"""Inverse depth is sought up to this multiple of the nearest point's, and down to this of the farthest's."""


@dataclass(frozen=True)
class InverseRange:
    """Inverse depths to search, farthest first, and the points' median."""

    far: float
    near: float
    middle: float


def inverse_range(posed: PosedViews, view: int) -> InverseRange:
    """From the points that the view sees, with room before them and behind them.

    Without points everything is taken to stand at depth 1.
    """
    z = _depths(posed, view, posed.visibility[view])
    if len(z) < FEW_POINTS:
        z = np.concatenate([_depths(posed, v, rows) for v, rows in enumerate(posed.visibility)])
    if not len(z):
        return InverseRange(BEHIND, BEFORE, 1.0)
    farthest, middle, nearest = (float(p) for p in np.percentile(1 / z, (1, 50, 99.5)))
    return InverseRange(BEHIND * farthest, BEFORE * nearest, middle)


def choose_sources(posed: PosedViews, view: int) -> list[int]:
    """Up to four views that share most points with this one at an angle that measures depth well, best first."""
    least, good, wide = ANGLES
    centres = posed.cameras.centres.double()
    own = posed.visibility[view]
    scored = []
    for other, rows in enumerate(posed.visibility):
        shared = own[torch.isin(own, rows)]
        if other == view or len(shared) < FEWEST_SHARED:
            continue
        points = posed.points[shared].double()
        one, two = points - centres[view], points - centres[other]
        # By the tangent: the arc cosine of a product that rounds to 1 would lose small angles.
        angles = torch.atan2(torch.linalg.cross(one, two).norm(dim=1), (one * two).sum(1))
        angle = float(torch.rad2deg(angles).median())
        if angle > least:
            scored.append((len(shared) * min(angle / good, 1.0) * min(wide / angle, 1.0) ** 2, other))
    return [other for _, other in sorted(scored, key=lambda pair: (-pair[0], pair[1]))[:SOURCES]]


def nearest_views(posed: PosedViews) -> list[list[int]]:
    """For each view the others that stand nearest, nearest first."""
    centres = posed.cameras.centres.double()
    order = torch.cdist(centres, centres).argsort(dim=1, stable=True).tolist()
    return [[other for other in row if other != view][:COMPARED_VIEWS] for view, row in enumerate(order)]


def _depths(posed: PosedViews, view: int, rows: torch.Tensor) -> np.ndarray:
    """Camera z of those of the points that lie before the camera."""
    w2c = posed.cameras.w2c[view].double()
    z = posed.points[rows].double() @ w2c[2, :3] + w2c[2, 3]
    return np.asarray(z[z > 0])
