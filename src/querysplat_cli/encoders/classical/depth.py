"""Depth of every view by classical multi-view stereo, from photos with cameras."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.encoders.classical.consistency import DepthMaps, blurred, carve, confirm, lent
from querysplat_cli.encoders.classical.contrast import stretch
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.depth_warnings import depth_warnings
from querysplat_cli.encoders.classical.fill_depth import fill_depth
from querysplat_cli.encoders.classical.neighbours import InverseRange, choose_sources, inverse_range, nearest_views
from querysplat_cli.encoders.classical.patch_features import PATCH, patch_features
from querysplat_cli.encoders.classical.patchmatch import Planes, Source, refine_planes
from querysplat_cli.encoders.classical.semiglobal import aggregate_costs, best_planes
from querysplat_cli.encoders.classical.sweep import cost_volume
from querysplat_cli.runtime.progress import Progress


def estimate_geometry(posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
    """Depth, confidence and patch features of every view.

    A sweep at half size finds the surfaces. Two rounds of plane refinement sharpen them; the second one also compares
    with the depths of the other views. Confidence is near 1 where two other views confirm a depth, about 1/2 where
    one does, and 0 where the depth was filled in. A filled depth never stands in front of what other views measured.
    Without parallax, the depth is constant with confidence 0. `warnings` says so, and where a few photos hardly agree.
    `seed` is unused: nothing is random here.
    """
    del seed
    views = posed.views
    masks = views.masks.numpy()
    sources = choose_sources(posed)
    ranges = [inverse_range(posed, v) for v in range(len(views))]
    if not any(sources):
        depth = torch.stack([torch.full(masks.shape[1:], 1 / limits.middle) for limits in ranges])
        warning = "depth is a guess: there is no parallax to measure it by"
        return _geometry(posed, depth, torch.zeros_like(depth), (warning,))
    pictures = views.images.permute(0, 2, 3, 1).contiguous().numpy()
    each = [_stretched(picture, mask) for picture, mask in zip(pictures, masks, strict=True)]
    photos = _as_sources(posed, each)
    planes = []
    for v, chosen in enumerate(sources):
        planes.append(_first_planes(photos, v, chosen, ranges[v]))
        progress(views.names[v], 0.6 * (v + 1) / len(views))
    measured = [replace(photo, inverse=found.inverse) for photo, found in zip(photos, planes, strict=True)]
    inverse, match = np.empty(masks.shape, np.float32), np.ones(masks.shape, np.float32)
    for v, chosen in enumerate(sources):
        inverse[v] = planes[v].inverse
        if chosen:
            found, match[v] = refine_planes(measured[v], [measured[s] for s in chosen], planes[v], ranges[v])
            inverse[v] = found.inverse
        progress(f"refining {views.names[v]}", 0.6 + 0.3 * (v + 1) / len(views))
    K, w2c = (part.double().numpy() for part in (posed.cameras.K, posed.cameras.w2c))
    confidence = confirm(inverse, masks, match, K, w2c, sources)
    # Colours of different views are compared, so that all are stretched alike, or none is.
    nearest, maps = nearest_views(posed), DepthMaps(inverse, confidence, blurred(_stretched(pictures, masks)), masks)
    others = lent(maps, K, w2c, nearest)
    for v in range(len(views)):
        borrowed = (others[v] > 0) & (confidence[v] < DEPTH_POLICY.guess_confidence) & masks[v]
        start = np.where(borrowed, others[v], inverse[v])
        weight = np.where(borrowed, np.float32(DEPTH_POLICY.lent_confidence), confidence[v])
        inverse[v] = fill_depth(start, weight, each[v], masks[v])
        inverse[v] = np.clip(inverse[v], ranges[v].far, ranges[v].near)
    progress("clearing free space", 0.95)
    least = [limits.far for limits in ranges]
    inverse = carve(replace(maps, inverse=inverse), K, w2c, nearest, least)
    depth, sure = torch.from_numpy(1 / inverse), torch.from_numpy(confidence)
    return _geometry(posed, depth, sure, depth_warnings(posed, depth, sure))


def _geometry(posed: PosedViews, depth: Tensor, confidence: Tensor, warnings: tuple[str, ...]) -> Geometry:
    return Geometry(depth, confidence, (patch_features(posed, depth, confidence),), PATCH, warnings)


def _stretched(pictures: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Pictures [..., height, width, 3] with the usual contrast where all of them together have little: dark, or fog."""
    inside = pictures[..., ::4, ::4, :][masks[..., ::4, ::4]]  # a sixteenth says as much
    found = stretch(inside, DEPTH_POLICY.little_contrast, DEPTH_POLICY.usual_contrast)
    if found is None:
        return pictures
    low, factor = map(np.float32, found)
    return np.clip((pictures - low) * factor, 0, 1)


def _as_sources(posed: PosedViews, pictures: Sequence[np.ndarray]) -> list[Source]:
    """Every view as a grey picture with its camera, without depth."""
    cameras, photos = posed.cameras, []
    for picture, mask, K, w2c in zip(pictures, posed.views.masks, cameras.K, cameras.w2c, strict=True):
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        grey[~mask.numpy()] = -1
        photos.append(Source(grey, K.double().numpy(), w2c.double().numpy(), np.zeros_like(grey)))
    return photos


def _first_planes(photos: list[Source], view: int, sources: list[int], limits: InverseRange) -> Planes:
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
    relative = [other.seen_from(view) for other in others]
    # About one pixel of disparity from plane to plane in the source with the longest baseline.
    shift = max(np.linalg.norm(T[:3, 3]) * other.K[0, 0] for other, T in zip(others, relative, strict=True))
    planes = int(np.clip(shift * (limits.near - limits.far), *DEPTH_POLICY.planes))
    steps = np.linspace(limits.far, limits.near, planes)
    costs = cost_volume(view.grey, view.K, [(o.grey, o.K, T) for o, T in zip(others, relative, strict=True)], steps)
    inverse = np.interp(best_planes(aggregate_costs(costs, view.grey)), np.arange(planes), steps).astype(np.float32)
    smooth = cv2.medianBlur(inverse, 5)
    slope_y, slope_x = (slope / 2 for slope in np.gradient(smooth))
    edge = np.abs(slope_x) + np.abs(slope_y) > DEPTH_POLICY.edge_slope * smooth
    slope_x[edge] = slope_y[edge] = 0
    return Planes(*(part.repeat(2, 0).repeat(2, 1) for part in (inverse, slope_x, slope_y)))
