"""Photos from one place: where the camera only turned, distances cannot be measured."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from querysplat_cli.encoders.classical.matches import Matches, Pair
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera

ROUNDS = 10
"""Of a robust fit."""


def placed_by_rotation(matches: Matches) -> SparseModel | None:
    """All photos of the largest group at one place, or None when rotations do not explain the matches.

    A rotation R maps pixels by K·R·K⁻¹. That also determines the focal length where EXIF does not give it. The
    model has no points, and its scale means nothing.
    """
    group = set(matches.largest_group())
    pairs = sorted((pair for pair in matches.pairs if pair.first in group), key=len, reverse=True)
    if not pairs:
        return None
    tested = sorted(pairs, key=_telling, reverse=True)[: CAMERA_POLICY.rotation_pairs]
    focals = _focals(matches, tested)
    errors = [_errors(pair, matches, focals, _robust_rotation(pair, matches, focals)) for pair in tested]
    if np.mean(np.concatenate(errors) < CAMERA_POLICY.rotation_tolerance) < CAMERA_POLICY.rotation_share:
        return None
    placed = {min(group): np.eye(3)}
    while len(placed) < len(group):
        pair = next(pair for pair in pairs if (pair.first in placed) != (pair.second in placed))
        turn = _robust_rotation(pair, matches, focals)
        if pair.first in placed:
            placed[pair.second] = turn @ placed[pair.first]
        else:
            placed[pair.first] = turn.T @ placed[pair.second]
    cameras = {photo: _camera(placed[photo], focals[photo], matches.sizes[photo]) for photo in sorted(placed)}
    return SparseModel(cameras, np.zeros((0, 3)), {photo: np.zeros(0, np.int64) for photo in cameras})


def _telling(pair: Pair) -> float:
    """How much a pair says of the motion: its matches, times the pixels that they moved.

    A burst of nearly equal photos has most matches of all, and rotations explain them however the others moved.
    """
    return len(pair) * float(np.median(np.linalg.norm(pair.second_pixels - pair.first_pixels, axis=1)))


def placed_alone(focal: float, size: tuple[int, int], photo: int = 0) -> SparseModel:
    """One photo at the origin, with the given focal length in pixels of its (height, width) `size`."""
    return SparseModel({photo: _camera(np.eye(3), focal, size)}, np.zeros((0, 3)), {photo: np.zeros(0, np.int64)})


def _camera(rotation: np.ndarray, focal: float, size: tuple[int, int]) -> PhotoCamera:
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    height, width = size
    return PhotoCamera(w2c, (focal, focal), (width / 2, height / 2), (0.0, 0.0, 0.0, 0.0), height, width)


def _focals(matches: Matches, pairs: Sequence[Pair]) -> list[float]:
    """Focal lengths of all photos in pixels: EXIF's, or else one common ratio with which rotations fit best."""
    stated = [matches.focal(photo) for photo in range(len(matches.sizes))]
    if all(matches.focals):
        return stated

    def focals(ratio: float) -> list[float]:
        return [known or ratio * max(size) for known, size in zip(matches.focals, matches.sizes, strict=True)]

    def mean_error(logarithm: float) -> float:
        tried = focals(float(np.exp(logarithm)))
        errors = [_errors(pair, matches, tried, _rotation(pair, matches, tried)) for pair in pairs]
        return float(np.minimum(np.concatenate(errors), 2 * CAMERA_POLICY.rotation_tolerance).mean())

    start = min(np.log(np.geomspace(*CAMERA_POLICY.rotation_focals, 12)), key=mean_error)
    best = minimize_scalar(mean_error, bounds=(start - 0.15, start + 0.15), method="bounded", options={"xatol": 1e-3})
    found = focals(float(np.exp(best.x)))
    largest = max(_angle(_robust_rotation(pair, matches, found)) for pair in pairs)
    return found if largest > np.radians(CAMERA_POLICY.informative_turn) else stated


def _angle(rotation: np.ndarray) -> float:
    return float(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))


def _directions(pixels: np.ndarray, size: tuple[int, int], focal: float) -> np.ndarray:
    height, width = size
    rays = np.column_stack([(pixels - [width / 2, height / 2]) / focal, np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rotation(pair: Pair, matches: Matches, focals: Sequence[float]) -> np.ndarray:
    """The rotation from the first camera's axes to the second's that fits all matches best."""
    one, two = _rays(pair, matches, focals)
    return _fitted(one, two, np.ones(len(one)))


def _robust_rotation(pair: Pair, matches: Matches, focals: Sequence[float]) -> np.ndarray:
    """The rotation that most matches agree on.

    A camera that turned has no epipole, so verification lets wrong matches through (up to half of them, with a focal
    length that is far from the prior). Their weights fall with the fourth power of their distance, in units of the
    median distance, which falls to the tolerance from round to round.
    """
    one, two = _rays(pair, matches, focals)
    least = CAMERA_POLICY.rotation_tolerance * max(matches.sizes[pair.second]) / focals[pair.second]
    weights = np.ones(len(one))
    for _ in range(ROUNDS):
        rotation = _fitted(one, two, weights)
        distance = np.linalg.norm(one @ rotation.T - two, axis=1)
        weights = (1 + (distance / max(least, float(np.median(distance)))) ** 2) ** -2
    return rotation


def _fitted(one: np.ndarray, two: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The rotation that takes the unit vectors `one` [n, 3] to `two` by weighted least squares (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((two * weights[:, None]).T @ one)
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def _rays(pair: Pair, matches: Matches, focals: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    one = _directions(pair.first_pixels, matches.sizes[pair.first], focals[pair.first])
    return one, _directions(pair.second_pixels, matches.sizes[pair.second], focals[pair.second])


def _errors(pair: Pair, matches: Matches, focals: Sequence[float], rotation: np.ndarray) -> np.ndarray:
    """Distances, in longer sides, between the first photo's features after the rotation and their matches."""
    one = _directions(pair.first_pixels, matches.sizes[pair.first], focals[pair.first])
    turned = one @ rotation.T
    height, width = matches.sizes[pair.second]
    # A ray that points behind the second camera has no pixel there.
    depth = np.where(turned[:, 2] > 1e-3, turned[:, 2], 1e-3)
    expected = turned[:, :2] / depth[:, None] * focals[pair.second] + [width / 2, height / 2]
    return np.asarray(np.linalg.norm(expected - pair.second_pixels, axis=1) / max(height, width))
