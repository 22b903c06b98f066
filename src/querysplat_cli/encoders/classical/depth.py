"""Depth of every view by classical multi-view stereo, from photos with cameras."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from querysplat_cli.encoders.base import Geometry, PosedViews, UsedDepthMaps
from querysplat_cli.encoders.classical.consistency import DepthMaps, blurred, carve, lent
from querysplat_cli.encoders.classical.contrast import stretch
from querysplat_cli.encoders.classical.depth_map_fit import fit_depth_maps
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.depth_warnings import depth_warnings
from querysplat_cli.encoders.classical.fill_depth import fill_depth
from querysplat_cli.encoders.classical.neighbours import choose_sources, inverse_range, nearest_views
from querysplat_cli.encoders.classical.patch_features import PATCH, patch_features
from querysplat_cli.encoders.classical.patchmatch import Source
from querysplat_cli.encoders.classical.stereo import measure
from querysplat_cli.encoders.classical.wide_windows import measure_wide
from querysplat_cli.runtime.progress import Progress


def estimate_geometry(posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
    """Depth, confidence and patch features of every view.

    Stereo measures it (`stereo.py`). Confidence is near 1 where two other views confirm a depth, about 1/2 where one
    does, and 0 where the depth was filled in: from what other views measured, from wider windows (`wide_windows.py`),
    and from the surroundings. A filled depth never stands in front of what other views measured.
    Without parallax, the depth is constant with confidence 0. `warnings` says so, and where a few photos hardly agree.
    Where the photos came with depth maps, these count where stereo finds nothing (`depth_map_fit.py`).
    `seed` is unused: nothing is random here.
    """
    del seed
    views = posed.views
    masks = views.masks.numpy()
    sources = choose_sources(posed)
    ranges = [inverse_range(posed, v) for v in range(len(views))]
    if not any(sources) and posed.depth_maps is None:
        depth = torch.stack([torch.full(masks.shape[1:], 1 / limits.middle) for limits in ranges])
        warning = "depth is a guess: there is no parallax to measure it by"
        return _geometry(posed, depth, torch.zeros_like(depth), (warning,))
    pictures = views.images.permute(0, 2, 3, 1).contiguous().numpy()
    each = [_stretched(picture, mask) for picture, mask in zip(pictures, masks, strict=True)]
    photos = _as_sources(posed, each)
    found = measure(photos, sources, ranges, lambda what, share: progress(what, 0.85 * share))
    given = None if posed.depth_maps is None else fit_depth_maps(posed.depth_maps.numpy(), found, ranges)
    if given:
        found, ranges = given.beside(found, photos, sources), given.ranges(ranges)
    progress("wide windows", 0.85)
    wide = measure_wide(photos, sources, ranges, found)
    inverse, confidence = found.inverse, found.confidence
    # Colours of different views are compared, so that all are stretched alike, or none is.
    nearest, maps = nearest_views(posed), DepthMaps(inverse, confidence, blurred(_stretched(pictures, masks)), masks)
    others, lent_confidence = lent(maps, photos, nearest), np.float32(DEPTH_POLICY.lent_confidence)
    for v in range(len(views)):
        guess = (confidence[v] < DEPTH_POLICY.guess_confidence) & masks[v]
        borrowed, wider = guess & (others[v] > 0), guess & (wide.inverse[v] > 0)
        start = np.select([borrowed, wider], [others[v], wide.inverse[v]], inverse[v])
        weight = np.select([borrowed, wider], [lent_confidence, wide.confidence[v]], confidence[v])
        inverse[v] = fill_depth(start, weight, each[v], masks[v])
        inverse[v] = np.clip(inverse[v], ranges[v].far, ranges[v].near)
    progress("clearing free space", 0.95)
    least = [limits.far for limits in ranges]
    inverse = carve(maps, photos, nearest, least)
    depth, sure = torch.from_numpy(1 / inverse), torch.from_numpy(confidence)
    warnings = (*depth_warnings(posed, depth, sure), *(given.warnings(views.names) if given else ()))
    return _geometry(posed, depth, sure, warnings, given.used if given else None)


def _geometry(
    posed: PosedViews,
    depth: Tensor,
    confidence: Tensor,
    warnings: tuple[str, ...],
    depth_maps: UsedDepthMaps | None = None,
) -> Geometry:
    return Geometry(depth, confidence, (patch_features(posed, depth, confidence),), PATCH, warnings, depth_maps)


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
