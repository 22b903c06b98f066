"""Depth of every view as windows of a few pixels match in other views, at the size of the pictures that are given."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from querysplat_cli.encoders.classical.consistency import confirm
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.neighbours import InverseRange
from querysplat_cli.encoders.classical.patchmatch import Planes, Source, refine_planes
from querysplat_cli.encoders.classical.semiglobal import aggregate_costs, best_planes
from querysplat_cli.encoders.classical.sweep import cost_volume
from querysplat_cli.runtime.progress import Progress


@dataclass(frozen=True)
class Measurement:
    """Inverse depth in 1 / scene units, and confidence (`consistency.confirm`): each [views, height, width]."""

    inverse: np.ndarray
    confidence: np.ndarray


def measure(
    photos: Sequence[Source],
    sources: Sequence[list[int]],
    ranges: Sequence[InverseRange],
    progress: Progress,
) -> Measurement:
    """The depth of every view from its own `sources`, and where they confirm it.

    A sweep at half size finds the surfaces. Two rounds of plane refinement sharpen them; the second one also compares
    with the depths of the other views. A view without sources has one depth and confidence 0. The sides of the
    pictures are even.
    """
    planes = []
    for v, chosen in enumerate(sources):
        planes.append(_first_planes(photos, v, chosen, ranges[v]))
        progress(f"view {v + 1} of {len(photos)}", 0.7 * (v + 1) / len(photos))
    measured = [replace(photo, inverse=found.inverse) for photo, found in zip(photos, planes, strict=True)]
    shape = len(photos), *photos[0].grey.shape
    inverse, match = np.empty(shape, np.float32), np.ones(shape, np.float32)
    for v, chosen in enumerate(sources):
        inverse[v] = planes[v].inverse
        if chosen:
            found, match[v] = refine_planes(measured[v], [measured[s] for s in chosen], planes[v], ranges[v])
            inverse[v] = found.inverse
        progress(f"refining view {v + 1} of {len(photos)}", 0.7 + 0.3 * (v + 1) / len(photos))
    shown = np.stack([photo.grey >= 0 for photo in photos])
    return Measurement(inverse, confirm(inverse, shown, match, photos, sources))


def _first_planes(photos: Sequence[Source], view: int, sources: list[int], limits: InverseRange) -> Planes:
    """The surfaces of one view from its own sources; constant where it has none."""
    grey = photos[view].grey
    if not sources:
        flat = np.zeros_like(grey)
        return Planes(np.full_like(grey, limits.middle), flat, flat)
    others = [photos[s] for s in sources]
    start = _swept(_halved(photos[view]), [_halved(other) for other in others], limits)
    found, _ = refine_planes(photos[view], others, start, limits)
    return found


def _halved(photo: Source) -> Source:
    """The same view at half the size. A pixel has no picture where one of its four pixels has none."""
    height, width = photo.grey.shape
    blocks = photo.grey.reshape(height // 2, 2, width // 2, 2)
    grey = np.where(blocks.min((1, 3)) < 0, np.float32(-1), blocks.mean((1, 3)))
    return replace(photo, grey=grey, K=np.diag([0.5, 0.5, 1.0]) @ photo.K)


def _swept(view: Source, others: list[Source], limits: InverseRange) -> Planes:
    """Surfaces by a sweep at the size of `view`, enlarged to twice that size."""
    # About one pixel of disparity from plane to plane in the source with the longest baseline.
    planes = int(
        np.clip(max(other.baseline(view) for other in others) * (limits.near - limits.far), *DEPTH_POLICY.planes)
    )
    steps = np.linspace(limits.far, limits.near, planes)
    costs = cost_volume(view.grey, view.K, [(o.grey, o.K, o.seen_from(view)) for o in others], steps)
    inverse = np.interp(best_planes(aggregate_costs(costs, view.grey)), np.arange(planes), steps).astype(np.float32)
    smooth = cv2.medianBlur(inverse, 5)
    slope_y, slope_x = (slope / 2 for slope in np.gradient(smooth))
    edge = np.abs(slope_x) + np.abs(slope_y) > DEPTH_POLICY.edge_slope * smooth
    slope_x[edge] = slope_y[edge] = 0
    return Planes(*(part.repeat(2, 0).repeat(2, 1) for part in (inverse, slope_x, slope_y)))
