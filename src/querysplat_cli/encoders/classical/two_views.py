"""Two photos: the relative pose and the lens that explain their matches best under the lens's prior.

Two photos rarely determine a focal length, and a plane leaves two poses for each. So candidates are made for several
focal lengths, from the essential matrix and from the homography. Each is adjusted under the prior, and the one of the
lowest cost is taken. Between poses that cost about the same, the pixels around the matches decide.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from querysplat_cli.encoders.classical.epipolar import epipolar_error, rays
from querysplat_cli.encoders.classical.least_squares import Bundle, LensPrior, Loss, Observations, adjust, project
from querysplat_cli.encoders.classical.lens_prior import ExpectedFocal, as_photo_camera, lens_prior
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.encoders.classical.verified_pairs import Pair
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.rotations import rotation_angles


@dataclass(frozen=True)
class _Candidate:
    """Adjusted cameras, the points that they share, the pixels [2, p, 2] of these, and what all this costs."""

    cost: float
    cameras: tuple[PhotoCamera, PhotoCamera]
    points: np.ndarray
    pixels: np.ndarray

    def model(self) -> SparseModel:
        rows = np.arange(len(self.points))
        return SparseModel(dict(enumerate(self.cameras)), self.points, {0: rows, 1: rows}, dict(enumerate(self.pixels)))


def map_two_photos(
    pair: Pair,
    sizes: Sequence[tuple[int, int]],
    focals: Sequence[float | None],
    expected: Sequence[ExpectedFocal],
    agreement: Callable[[SparseModel], float],
) -> tuple[SparseModel, Pair] | None:
    """The model of two photos and the matches that its cameras explain, or None where too few agree.

    `pair` may hold wrong matches. `sizes` are (height, width), `focals` EXIF's focal lengths in pixels, or None, and
    `expected` what is to be expected without. `agreement` says how far the photos agree with a model, as a share; it is
    asked only where several poses explain the matches about as well.
    """
    policy = CAMERA_POLICY
    fewest = max(policy.fewest_two_view_points, policy.fewest_two_view_share * len(pair))
    if len(pair) < fewest:
        return None

    def ordered_by_cost(lenses: Sequence[int], numbers: Sequence[tuple[float, float]]) -> list[_Candidate]:
        count = max(lenses) + 1
        prior = lens_prior(sizes[:count], focals[:count], expected[:count], two_photos=True)
        usual, spread = prior.mean[lenses, 0], prior.sigma[lenses, 0]
        candidates = [
            _adjusted(pair, start, prior, np.array(lenses), sizes)
            for number in numbers
            for start in _starts(pair, sizes, np.exp(usual + np.array(number) * spread))
        ]
        return sorted((each for each in candidates if each), key=lambda each: each.cost)

    shared = share_a_lens(sizes, focals, expected)
    ordered = ordered_by_cost(
        [0, 0] if shared else [0, 1], [(0.0, 0.0)] if all(focals) else [(each, each) for each in policy.tried_focals]
    )
    if ordered and shared and not any(focals):
        apart = ordered_by_cost([0, 1], policy.tried_zooms)
        ordered = apart if apart and _zoomed(apart[0], ordered[0]) else ordered
    if not ordered or len(ordered[0].points) < fewest:
        return None
    best = _chosen([each for each in ordered if len(each.points) >= fewest], agreement)
    agreeing = epipolar_error(pair, *best.cameras) < policy.epipolar_tolerance
    return best.model(), Pair(0, 1, pair.first_pixels[agreeing], pair.second_pixels[agreeing])


def share_a_lens(
    sizes: Sequence[tuple[int, int]], focals: Sequence[float | None], expected: Sequence[ExpectedFocal]
) -> bool:
    """Whether nothing that is known of the two photos before their matches says that their lenses differ."""
    return all(some[0] == some[1] for some in (sizes, focals, expected))


def _zoomed(apart: _Candidate, shared: _Candidate) -> bool:
    """Whether the photos fit far better with two focal lengths that differ, as of a zoomed photo and another one."""
    one, two = (camera.focal[0] for camera in apart.cameras)
    differ = abs(np.log(two / one)) > np.log1p(CAMERA_POLICY.zoom_difference)
    return bool(differ and apart.cost < CAMERA_POLICY.lens_apart_cost * shared.cost)


def _chosen(ordered: Sequence[_Candidate], agreement: Callable[[SparseModel], float]) -> _Candidate:
    """The first candidate, which costs least, or a rival of another pose with which the photos agree far better."""
    rivals: list[_Candidate] = []
    for each in ordered:
        affordable = each.cost <= CAMERA_POLICY.rival_cost * ordered[0].cost
        if affordable and all(_degrees_apart(each, other) > CAMERA_POLICY.rival_angle for other in rivals):
            rivals.append(each)
    if len(rivals) == 1:
        return rivals[0]
    shares = [agreement(each.model()) for each in rivals]
    best = int(np.argmax(shares))
    return rivals[best] if shares[best] > CAMERA_POLICY.rival_agreement * shares[0] else rivals[0]


def _degrees_apart(one: _Candidate, two: _Candidate) -> float:
    """The larger of the angles between their turns and between the directions of their shifts."""
    first, second = (each.cameras[1].w2c @ np.linalg.inv(each.cameras[0].w2c) for each in (one, two))
    turn = float(rotation_angles(torch.from_numpy(first[:3, :3] @ second[:3, :3].T)))
    sine, cosine = np.linalg.norm(np.cross(first[:3, 3], second[:3, 3])), first[:3, 3] @ second[:3, 3]
    return max(turn, float(np.degrees(np.arctan2(sine, cosine))))


def _starts(
    pair: Pair, sizes: Sequence[tuple[int, int]], focals: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Focal lengths [2] and relative poses [3, 4] of unit shift: of the essential matrix, and of the homography."""
    cameras = [
        as_photo_camera(np.eye(3, 4), _ideal(focal, size), size) for focal, size in zip(focals, sizes, strict=True)
    ]
    one, two = rays(pair.first_pixels, cameras[0]), rays(pair.second_pixels, cameras[1])
    tolerance = CAMERA_POLICY.calibrated_tolerance * max(sizes[0]) / float(focals.mean())
    essential, inside = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, 0.9999, tolerance)
    if essential is not None and essential.shape == (3, 3):
        _, turn, shift, _ = cv2.recoverPose(essential, one, two, np.eye(3), mask=inside.copy())
        yield focals, np.column_stack([turn, shift])
    plane, _ = cv2.findHomography(one, two, cv2.RANSAC, tolerance)
    if plane is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(plane, np.eye(3))
        for turn, shift in zip(turns, shifts, strict=True):
            if np.linalg.norm(shift) > CAMERA_POLICY.rotation_tolerance:
                yield focals, np.column_stack([turn, shift / np.linalg.norm(shift)])


def _ideal(focal: float, size: tuple[int, int]) -> np.ndarray:
    return np.array([np.log(focal), size[1] / 2, size[0] / 2, 0.0, 0.0])


def _adjusted(
    pair: Pair,
    start: tuple[np.ndarray, np.ndarray],
    prior: LensPrior,
    lenses: np.ndarray,
    sizes: Sequence[tuple[int, int]],
) -> _Candidate | None:
    """The candidate after adjustment on the matches that it explains, or None where these are too few."""
    policy = CAMERA_POLICY
    focals, pose = start
    count = int(lenses.max()) + 1
    table = np.array([_ideal(focals[lens], sizes[lens]) for lens in range(count)])
    bundle = Bundle(np.stack([np.eye(3, 4), pose]), lenses, table, np.zeros((0, 3)))
    before = None
    for _ in range(policy.most_two_view_rounds):
        cameras = _cameras(bundle, sizes)
        points = _triangulated(pair, cameras)
        good = _in_front(points, cameras) & (epipolar_error(pair, *cameras) < policy.epipolar_tolerance)
        if good.sum() < policy.fewest_two_view_points:
            return None
        if before is not None and np.count_nonzero(good != before) <= policy.settled_share * good.sum():
            break
        before = good
        seen = _observations(pair, good)
        weight = min(1.0, policy.independent_observations / len(seen.pixels))
        loss = Loss(policy.adjustment_loss_scale, weight)
        start_bundle = Bundle(bundle.poses, lenses, bundle.lenses, points[good])
        bundle = adjust(start_bundle, seen, prior, loss)
    cameras = _cameras(bundle, sizes)
    residuals = np.linalg.norm(project(bundle, seen)[0] - seen.pixels, axis=1).reshape(2, -1).max(0)
    worst = np.minimum(epipolar_error(pair, *cameras), policy.epipolar_tolerance)
    worst[~_in_front(_triangulated(pair, cameras), cameras)] = policy.epipolar_tolerance
    cost = loss.total(worst**2) + prior.cost(bundle.lenses)
    kept = residuals < policy.epipolar_tolerance
    pixels = seen.pixels.reshape(2, -1, 2)[:, kept]
    return _Candidate(cost, cameras, bundle.points[kept], pixels) if kept.any() else None


def _cameras(bundle: Bundle, sizes: Sequence[tuple[int, int]]) -> tuple[PhotoCamera, PhotoCamera]:
    one, two = (as_photo_camera(bundle.poses[i], bundle.lenses[bundle.lens_of[i]], sizes[i]) for i in (0, 1))
    return one, two


def _triangulated(pair: Pair, cameras: tuple[PhotoCamera, PhotoCamera]) -> np.ndarray:
    """Points [m, 3] of the matches, in the world."""
    one, two = rays(pair.first_pixels, cameras[0]), rays(pair.second_pixels, cameras[1])
    found = cv2.triangulatePoints(cameras[0].w2c[:3], cameras[1].w2c[:3], one.T, two.T)
    scale = np.where(np.abs(found[3]) > 1e-9, found[3], 1e-9)
    return np.asarray((found[:3] / scale).T)


def _in_front(points: np.ndarray, cameras: tuple[PhotoCamera, PhotoCamera]) -> np.ndarray:
    return np.all([points @ camera.w2c[2, :3] + camera.w2c[2, 3] > 0 for camera in cameras], axis=0)


def _observations(pair: Pair, good: np.ndarray) -> Observations:
    count = int(good.sum())
    pixels = np.concatenate([pair.first_pixels[good], pair.second_pixels[good]])
    return Observations(pixels, np.repeat([0, 1], count), np.tile(np.arange(count), 2))
