"""Camera paths for films of a scene."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras, distances
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.upright import up_direction

RING_GAP = 2.1
"""The inputs surround their middle when no gap between their directions is wider than this, in radians."""
LEAST_SWAY = 0.05
"""Half the width and height of the path in radians, where all inputs were taken from one place."""
DEPTH_VIEWS = 8
"""Cameras that `usual_depth` asks, at most."""
ORBIT_SHARE = 0.8
"""Share of the inputs' angular range that the path uses. Near the ends fewer photos show what is rendered."""


def orbit(cameras: Cameras, middle: Float[Tensor, "3"], frames: int) -> Cameras:
    """A closed, smooth path around `middle`, looking at it, at the inputs' typical distance and height.

    Where the inputs surround `middle`, so does the path. Where they stand on one side (a forward-facing capture), it is
    an ellipse on that side, within their angular range. The up direction is estimated from all inputs. The focal
    lengths are the medians of theirs, and the principal point is the middle of their canvas. Raises QuerySplatError
    when the inputs' centres are at `middle`.
    """
    centres, target = cameras.centres.double().numpy(), middle.double().numpy()
    up = up_direction(cameras)
    arms = centres - target
    radius = float(np.median(np.linalg.norm(arms, axis=1)))
    if radius == 0:
        raise QuerySplatError("the cameras are at the point to look at", "Give a path with --cameras FILE.")
    forward = _unit(np.cross(up, _least_parallel_axis(up)))
    side = np.cross(up, forward)
    azimuth = np.arctan2(arms @ side, arms @ forward)
    elevation = np.arctan2(arms @ up, np.hypot(arms @ side, arms @ forward))
    turn = 2 * np.pi * np.arange(frames) / frames
    start, covered = _widest_gap(azimuth)
    if 2 * np.pi - covered < RING_GAP:
        path_azimuth = azimuth[0] + turn
        path_elevation = np.full(frames, np.median(elevation))
    else:
        path_azimuth = start + covered / 2 + max(LEAST_SWAY, ORBIT_SHARE * covered / 2) * np.sin(turn)
        height = max(LEAST_SWAY, ORBIT_SHARE * float(np.ptp(elevation)) / 2)
        path_elevation = (elevation.min() + elevation.max()) / 2 + height * np.cos(turn)
    path_elevation = path_elevation.clip(-1.4, 1.4)[:, None]
    level = np.cos(path_azimuth)[:, None] * forward + np.sin(path_azimuth)[:, None] * side
    places = target + radius * (np.cos(path_elevation) * level + np.sin(path_elevation) * up)
    return look_at(places, target, up, cameras)


def opaque_centres(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Centres of the Gaussians that stand for surfaces (`Gaussians.surfaces`)."""
    return gaussians.means[gaussians.surfaces]


def usual_depth(gaussians: Gaussians, cameras: Cameras) -> float:
    """The median depth of `opaque_centres` before some of the cameras; 1 where none lies before them.

    It is about 1 in the units in which scenes are made, and tells the unit of a file of another program.
    """
    centres = opaque_centres(gaussians)
    some, cameras = evenly_spaced(range(len(cameras)), DEPTH_VIEWS), cameras.to(centres.dtype)
    depths = torch.cat([centres[:0, 2], *(cameras.local(centres, view)[:, 2] for view in some)])
    ahead = depths[depths > 0]
    return float(ahead.median()) if len(ahead) else 1.0


def scene_middle(gaussians: Gaussians) -> Float[Tensor, "3"]:
    """The median of `opaque_centres`, which films and viewers turn around."""
    return opaque_centres(gaussians).median(0).values


def first_shown(cameras: Cameras) -> int:
    """The number of the camera from which viewers show a scene first: that in the middle of the list."""
    return len(cameras) // 2


def surround(points: Float[Tensor, "n 3"], frames: int, height: int, width: int) -> Cameras:
    """A full circle around a scene without cameras, seen slightly from above; y is assumed to point down.

    The distance is such that nine tenths of the points fit into the picture. Its field of view is 50° along the shorter
    side.
    """
    target = points.double().median(0).values.numpy()
    reach = float(np.quantile(np.linalg.norm(points.double().numpy() - target, axis=1), 0.9)) or 1.0
    half = np.radians(25)
    turn = 2 * np.pi * np.arange(frames) / frames
    places = target + reach / np.sin(half) * np.stack([np.sin(turn), np.full(frames, -0.35), -np.cos(turn)], 1)
    focal = min(height, width) / 2 / np.tan(half)
    K = points.new_tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    like = Cameras(torch.eye(4).to(K)[None], K[None], height, width)
    return look_at(places, target, np.array([0.0, -1.0, 0.0]), like)


def interpolate(cameras: Cameras, frames: int) -> Cameras:
    """A smooth path through the inputs in their order, first to last.

    Centres follow a monotone cubic. Between two inputs, rotations take the shortest way at constant speed, and
    intrinsics change linearly.
    """
    if len(cameras) == 1:
        return cameras[[0] * frames]
    knots, times = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, frames)
    c2w = cameras.c2w.double().numpy()
    path = np.tile(np.eye(4), (frames, 1, 1))
    path[:, :3, :3] = Slerp(knots, Rotation.from_matrix(c2w[:, :3, :3]))(times).as_matrix()
    path[:, :3, 3] = PchipInterpolator(knots, c2w[:, :3, 3])(times)
    previous = np.minimum(times.astype(int), len(cameras) - 2)
    share = torch.from_numpy(times - previous).to(cameras.K.dtype)[:, None, None]
    K = torch.lerp(cameras.K[previous], cameras.K[previous + 1], share)
    return _cameras(path, K, cameras)


def halfway(cameras: Cameras) -> Cameras:
    """A camera in the middle between each and the one nearest to it, one for each such pair; a single camera itself."""
    if len(cameras) == 1:
        return cameras
    apart = distances(cameras.centres, cameras.centres).fill_diagonal_(math.inf)
    pairs = sorted({(min(pair), max(pair)) for pair in enumerate(apart.argmin(1).tolist())})
    return Cameras.joined([on_the_line(cameras[list(pair)], 0.5) for pair in pairs])


def on_the_line(pair: Cameras, share: float) -> Cameras:
    """The camera at `share` of the way from one to the other, beyond them below 0 and above 1; it turns evenly."""
    c2w = pair.c2w.double().numpy()
    start, end = (Rotation.from_matrix(each[:3, :3]) for each in c2w)
    place = np.eye(4)
    place[:3, :3] = (start * Rotation.from_rotvec(share * (start.inv() * end).as_rotvec())).as_matrix()
    place[:3, 3] = (1 - share) * c2w[0, :3, 3] + share * c2w[1, :3, 3]
    return _cameras(place[None], torch.lerp(pair.K[:1], pair.K[1:], share), pair)


def look_at(places: np.ndarray, target: np.ndarray, up: np.ndarray, like: Cameras) -> Cameras:
    """Cameras at `places` [n, 3] towards `target` [3] or [n, 3]; canvas and median focal lengths of `like`."""
    z = target - places
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, up)
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    path = np.tile(np.eye(4), (len(places), 1, 1))
    path[:, :3, :3] = np.stack([x, np.cross(z, x), z], 2)
    path[:, :3, 3] = places
    return centred(_cameras(path, like.K.median(0).values.expand(len(places), 3, 3), like))


def centred(cameras: Cameras) -> Cameras:
    """The same cameras, looking through the middle of their canvas. Photos of several shapes have several middles."""
    K = cameras.K.clone()
    K[:, 0, 2], K[:, 1, 2] = cameras.width / 2, cameras.height / 2
    return replace(cameras, K=K)


def _cameras(c2w: np.ndarray, K: Tensor, like: Cameras) -> Cameras:
    # A rigid inverse is the same in both directions.
    w2c = Cameras(torch.from_numpy(c2w), K, like.height, like.width).c2w
    return Cameras(w2c.to(like.w2c.dtype), K.clone(), like.height, like.width)


def _widest_gap(azimuth: np.ndarray) -> tuple[float, float]:
    """Where the range of the angles begins, and how far it reaches, when the widest gap is left out."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest])


def _least_parallel_axis(direction: np.ndarray) -> np.ndarray:
    return np.eye(3)[np.abs(direction).argmin()]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
