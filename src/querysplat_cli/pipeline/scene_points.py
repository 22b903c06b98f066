"""The points of structure from motion that a scene keeps."""

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.scene.sparse_points import SparsePoints


def scene_points(posed: PosedViews) -> SparsePoints | None:
    """The points that at least two of the views observe, in their mean colours; None where there are none."""
    if posed.keypoints is None:
        return None
    count = torch.tensor([len(rows) for rows in posed.visibility])
    view = torch.arange(len(count)).repeat_interleave(count)
    point, pixels = torch.cat(posed.visibility).long(), torch.cat(posed.keypoints)
    shared = torch.bincount(point, minlength=len(posed.points)) > 1
    if not shared.any():
        return None
    kept = shared[point]
    rows = shared.cumsum(0) - 1
    view, point, pixels = view[kept], rows[point[kept]], pixels[kept]
    places = posed.points[shared]
    colours = _colours(posed, places, view, point)
    return SparsePoints(places.float(), colours, view.int(), point.int(), pixels.float())


def _colours(posed: PosedViews, places: torch.Tensor, view: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Mean colour [n, 3], of 255, of the pixels that show each place. `view` does not fall."""
    total, weight = torch.zeros(len(places), 3), torch.zeros(len(places), 1)
    of_views = point.split(torch.bincount(view, minlength=len(posed.views)).tolist())
    for i, ((height, width), seen) in enumerate(zip(posed.views.sizes, of_views, strict=True)):
        x, y, _ = posed.cameras.project(places[seen], i)
        column, row = x.long().clamp(0, width - 1), y.long().clamp(0, height - 1)
        total.index_add_(0, seen, posed.views.picture(i)[:, row, column].T)
        weight.index_add_(0, seen, torch.ones(len(seen), 1))
    return (255 * total / weight).round().clamp(0, 255).to(torch.uint8)
