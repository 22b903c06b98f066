"""Structure from motion: matches in, cameras and points out (COLMAP's incremental mapper)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.epipolar import supported
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera

DISTORTION = {
    "SIMPLE_PINHOLE": lambda: (0.0, 0.0, 0.0, 0.0),
    "PINHOLE": lambda: (0.0, 0.0, 0.0, 0.0),
    "SIMPLE_RADIAL": lambda k: (k, 0.0, 0.0, 0.0),
    "RADIAL": lambda k1, k2: (k1, k2, 0.0, 0.0),
    "OPENCV": lambda k1, k2, p1, p2: (k1, k2, p1, p2),
}
"""OpenCV's (k1, k2, p1, p2) from the extra parameters of COLMAP's lens models."""
PLACED = 0.9
"""Share of the connected photos with which an attempt counts as a success."""
AGREEING = 0.7
"""Share of the matches between placed photos that a sound model explains."""


@dataclass(frozen=True)
class Attempt:
    """How much the mapper asks of its first pair and of the photos it adds.

    Angles in degrees: between the rays of the first pair (`start_angle`) and of any point (`point_angle`).
    """

    start_angle: float
    start_inliers: int
    point_angle: float
    pose_inliers: int
    forward_motion: float


ATTEMPTS = (
    # Handfuls of photos need less than COLMAP asks of a thousand, and all their two-view tracks.
    Attempt(start_angle=4, start_inliers=50, point_angle=1.5, pose_inliers=30, forward_motion=0.95),
    Attempt(start_angle=12, start_inliers=80, point_angle=1.5, pose_inliers=20, forward_motion=0.95),
    Attempt(start_angle=1, start_inliers=20, point_angle=0.5, pose_inliers=15, forward_motion=1.0),
)
EXTENDING = replace(ATTEMPTS[-1], pose_inliers=12)


def map_photos(matches: Matches, *, seed: int) -> SparseModel | None:
    """The largest model whose cameras the matches support, or None when no two photos make one.

    Each attempt starts elsewhere; the first that places the connected photos in agreement with their
    matches ends the search, else the one that explains most matches is kept and extended.
    """
    best, best_support, connected = None, 0, _largest_component(matches)
    for attempt in ATTEMPTS:
        for model in _models(matches, attempt, seed):
            support = supported(model, matches)
            if best is None or support.explained > best_support:
                best, best_support = model, support.explained
            if len(model.cameras) >= PLACED * connected and support.share >= AGREEING:
                return _extended(best, matches, seed) if len(best.cameras) < connected else best
    return best and _extended(best, matches, seed)


def from_colmap(reconstruction: pycolmap.Reconstruction, matches: Matches) -> SparseModel:
    """COLMAP's placed images and their points, numbered as our photos."""
    ids = sorted(reconstruction.points3D)
    row = {point: i for i, point in enumerate(ids)}
    points = np.array([reconstruction.points3D[point].xyz for point in ids]).reshape(-1, 3)
    cameras, seen = {}, {}
    for image in reconstruction.images.values():
        if image.has_pose:
            photo = matches.images.index(image.name)
            cameras[photo] = _photo_camera(image)
            rows = {row[point.point3D_id] for point in image.get_observation_points2D()}
            seen[photo] = np.array(sorted(rows), dtype=np.int64)
    order = sorted(cameras)
    return SparseModel({i: cameras[i] for i in order}, points, {i: seen[i] for i in order})


def _photo_camera(image: pycolmap.Image) -> PhotoCamera:
    camera = image.camera
    w2c = np.eye(4)
    w2c[:3] = image.cam_from_world().matrix()
    extra = [float(camera.params[i]) for i in camera.extra_params_idxs()]
    return PhotoCamera(
        w2c,
        (float(camera.focal_length_x), float(camera.focal_length_y)),
        (float(camera.principal_point_x), float(camera.principal_point_y)),
        DISTORTION[camera.model_name](*extra),
        camera.height,
        camera.width,
    )


def _largest_component(matches: Matches) -> int:
    """Photos in the largest group that pairs connect."""
    group = list(range(len(matches.images)))
    for pair in matches.pairs:
        one, two = group[pair.first], group[pair.second]
        group = [one if member == two else member for member in group]
    return max(map(group.count, group))


def _models(matches: Matches, attempt: Attempt, seed: int) -> list[SparseModel]:
    with TemporaryDirectory(dir=matches.folder) as output:
        found = pycolmap.incremental_mapping(
            matches.database, matches.folder, Path(output), _options(attempt, seed, multiple=True)
        )
    return [from_colmap(found[i], matches) for i in sorted(found)]


def _extended(model: SparseModel, matches: Matches, seed: int) -> SparseModel:
    return model


def _options(attempt: Attempt, seed: int, *, multiple: bool) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.multiple_models = multiple
    options.min_model_size = 2
    options.extract_colors = False
    # One thread and one seed: the same photos give the same bits.
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.init_min_tri_angle = attempt.start_angle
    options.mapper.init_min_num_inliers = attempt.start_inliers
    options.mapper.init_max_forward_motion = attempt.forward_motion
    options.mapper.abs_pose_min_num_inliers = attempt.pose_inliers
    options.mapper.filter_min_tri_angle = attempt.point_angle
    options.triangulation.min_angle = attempt.point_angle
    options.triangulation.ignore_two_view_tracks = False
    return options
