"""Depth of every view, from photos whose cameras are known (classical multi-view stereo)."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from querysplat_cli.encoders.base import Geometry, Located
from querysplat_cli.encoders.classical.features import PATCH, patch_features
from querysplat_cli.encoders.classical.fill import fill
from querysplat_cli.encoders.classical.semiglobal import aggregate, choose
from querysplat_cli.encoders.classical.sweep import WORST, cost_volume
from querysplat_cli.progress import Progress
from querysplat_cli.scene.cameras import Cameras

SOURCES = 4
PLANES = (48, 128)
"""Fewest and most planes of a sweep."""
AGREEMENT = 0.02
"""Relative depth difference up to which two views confirm each other."""


def perceive(located: Located, *, seed: int, progress: Progress) -> Geometry:
    """Depth, confidence and patch features of every view.

    Confidence is 1 where two other views confirm the depth, about 1/2 where one does, and 0 where it had to
    be filled in. Without parallax there is nothing to measure: depth is then a plain guess of confidence 0,
    and `doubts` says so. `seed` is not needed: nothing here is random.
    """
    del seed
    views, cameras = located.views, located.cameras
    masks = views.masks.numpy()
    sources = [_sources(located, v) for v in range(len(views))]
    if not any(sources):
        depth = np.ones(masks.shape, np.float32)
        return _geometry(located, depth, np.zeros_like(depth), ("depth is a guess: there is no parallax to measure it by",))
    grey = [cv2.cvtColor(image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY) for image in views.images]
    K, w2c = cameras.K.double().numpy(), cameras.w2c.double().numpy()
    inverse = np.zeros(masks.shape, np.float32)
    match = np.ones(masks.shape, np.float32)
    for v in range(len(views)):
        if not sources[v]:
            inverse[v] = 1.0
            continue
        neighbours = [(grey[s], K[s], w2c[s] @ np.linalg.inv(w2c[v])) for s in sources[v]]
        inverse[v], match[v] = _sweep_view(grey[v], K[v], neighbours, _range(located, v))
        progress(views.names[v], 0.8 * (v + 1) / len(views))
    confidence = _confirm(inverse, match, cameras, sources, masks)
    for v in range(len(views)):
        inverse[v] = fill(inverse[v], confidence[v], views.images[v].permute(1, 2, 0).numpy(), masks[v])
        progress(f"fill {views.names[v]}", 0.8 + 0.2 * (v + 1) / len(views))
    return _geometry(located, 1 / np.maximum(inverse, 1e-2), confidence, ())


def _geometry(located: Located, depth: np.ndarray, confidence: np.ndarray, doubts: tuple[str, ...]) -> Geometry:
    z, sure = torch.from_numpy(depth), torch.from_numpy(confidence)
    return Geometry(z, sure, (patch_features(located, z, sure),), PATCH, doubts)


@dataclass(frozen=True)
class _Range:
    """Inverse depths to sweep, nearest last."""

    far: float
    near: float


def _range(located: Located, view: int) -> _Range:
    """From the sparse points that the view sees, with room before them and behind them, to the far background."""
    z = _depths(located, view, located.visibility[view])
    if len(z) < 8:
        z = np.concatenate([_depths(located, v, located.visibility[v]) for v in range(len(located.views))])
    inverse = 1 / z[z > 0]
    return _Range(0.2 * float(np.percentile(inverse, 1)), 1.25 * float(np.percentile(inverse, 99.5)))


def _depths(located: Located, view: int, rows: torch.Tensor) -> np.ndarray:
    w2c = located.cameras.w2c[view].double()
    return (located.points[rows].double() @ w2c[2, :3] + w2c[2, 3]).numpy()


def _sources(located: Located, view: int) -> list[int]:
    """Views that share most points with this one under an angle that measures depth well, best first."""
    centres = located.cameras.centres.double()
    own = set(located.visibility[view].tolist())
    scored = []
    for other in range(len(located.views)):
        shared = sorted(own.intersection(located.visibility[other].tolist())) if other != view else []
        if len(shared) < 5:
            continue
        points = located.points[shared].double()
        one, two = points - centres[view], points - centres[other]
        cosine = torch.nn.functional.cosine_similarity(one, two).clamp(-1, 1)
        angle = float(torch.rad2deg(torch.arccos(cosine)).median())
        if angle > 0.3:
            scored.append((len(shared) * min(angle / 6, 1.0) * min(25 / angle, 1.0) ** 2, other))
    return [other for _, other in sorted(scored, key=lambda pair: (-pair[0], pair[1]))[:SOURCES]]


def _sweep_view(
    grey: np.ndarray, K: np.ndarray, sources: list[tuple[np.ndarray, np.ndarray, np.ndarray]], limits: _Range
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and match (0 perfect, 1 none) of one view."""
    # About one pixel of disparity from plane to plane in the source with the longest baseline.
    shifts = [np.linalg.norm(transform[:3, 3]) * source_K[0, 0] for _, source_K, transform in sources]
    planes = int(np.clip(max(shifts) * (limits.near - limits.far), *PLANES))
    steps = np.linspace(limits.far, limits.near, planes)
    costs = cost_volume(grey, K, sources, steps)
    plane = np.empty(grey.shape, np.float32)
    match = np.empty(grey.shape, np.float32)
    choose(aggregate(costs, grey), costs, plane, match)
    return np.interp(plane, np.arange(planes), steps).astype(np.float32), match / WORST


def _confirm(
    inverse: np.ndarray, match: np.ndarray, cameras: Cameras, sources: list[list[int]], masks: np.ndarray
) -> np.ndarray:
    """Confidence [views, height, width]: how many of its sources put a surface where a view saw one."""
    K, w2c = cameras.K.double().numpy(), cameras.w2c.double().numpy()
    height, width = cameras.height, cameras.width
    y, x = np.mgrid[:height, :width] + 0.5
    confidence = np.zeros(inverse.shape, np.float32)
    for v, others in enumerate(sources):
        rays = np.stack([(x - K[v, 0, 2]) / K[v, 0, 0], (y - K[v, 1, 2]) / K[v, 1, 1], np.ones_like(x)], -1)
        points = rays / np.maximum(inverse[v], 1e-6)[..., None]
        votes = np.zeros((height, width), np.float32)
        for s in others:
            transform = w2c[s] @ np.linalg.inv(w2c[v])
            local = points @ transform[:3, :3].T + transform[:3, 3]
            z = np.maximum(local[..., 2], 1e-6)
            u = (local[..., 0] / z * K[s, 0, 0] + K[s, 0, 2] - 0.5).astype(np.float32)
            t = (local[..., 1] / z * K[s, 1, 1] + K[s, 1, 2] - 0.5).astype(np.float32)
            there = cv2.remap(inverse[s], u, t, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
            votes += (local[..., 2] > 0) & (np.abs(there * z - 1) < AGREEMENT)
        needed = min(2, max(1, len(others)))
        confidence[v] = np.minimum(votes / needed, 1) * np.clip(1.3 - match[v], 0, 1)
    return confidence * masks
