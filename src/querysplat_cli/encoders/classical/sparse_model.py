"""The result of structure from motion: cameras, and points that they share."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class SparseModel:
    """Cameras by photo number, and scene points [n, 3] in float64.

    `seen` holds, for each photo, the rows of the points that its camera observes, and `pixels` where it does [k, 2], in
    pixels of its camera. Every point is observed.
    """

    cameras: dict[int, PhotoCamera]
    points: np.ndarray
    seen: dict[int, np.ndarray]
    pixels: dict[int, np.ndarray] = field(default_factory=dict)

    def depths(self, photo: int) -> np.ndarray:
        """Camera z of the points that a photo's camera observes, in scene units."""
        w2c = self.cameras[photo].w2c
        return np.asarray(self.points[self.seen[photo]] @ w2c[2, :3] + w2c[2, 3])

    def errors(self, photo: int) -> np.ndarray:
        """Distances [n] in pixels between what a photo observes and the projections of these points."""
        camera = self.cameras[photo]
        if not len(self.seen[photo]):
            return np.empty(0)  # OpenCV refuses to project nothing
        turn, shift = cv2.Rodrigues(camera.w2c[:3, :3])[0], camera.w2c[:3, 3]
        places = self.points[self.seen[photo]]
        projected, _ = cv2.projectPoints(places, turn, shift, camera.K, np.array(camera.distortion))
        return np.asarray(np.linalg.norm(projected.reshape(-1, 2) - self.pixels[photo], axis=1))

    def centre(self, photo: int) -> np.ndarray:
        """The camera centre of a photo [3], in the world."""
        w2c = self.cameras[photo].w2c
        return np.asarray(-w2c[:3, :3].T @ w2c[:3, 3])


def mean_error(model: SparseModel) -> float:
    """The mean over the photos of `photo_error`."""
    return float(np.mean([photo_error(model, photo) for photo in model.cameras]))


def photo_error(model: SparseModel, photo: int) -> float:
    """The mean error of a photo's observations in pixels, each cut off where it says only that a match is wrong.

    Nothing holds a photo without observations, so that its error is that of wrong ones.
    """
    errors = model.errors(photo)
    return float(np.fmin(errors, CAMERA_POLICY.wrong_error).mean()) if len(errors) else CAMERA_POLICY.wrong_error


def misplaced(model: SparseModel) -> list[int]:
    """Photos that wrong matches seem to have placed: they fit far worse than the others. None of three or fewer."""
    policy, errors = CAMERA_POLICY, {photo: photo_error(model, photo) for photo in model.cameras}
    if len(errors) < policy.judged_photos:
        return []
    wrong = []
    for photo, error in errors.items():
        others = float(np.median([each for other, each in errors.items() if other != photo]))
        if error > max(policy.misplaced_error, policy.misplaced_ratio * others):
            wrong.append(photo)
    return wrong


def in_first_camera_frame(model: SparseModel) -> SparseModel:
    """The same model with the first photo's camera as origin and a median depth of 1.

    The median is over all observations of all cameras. Without points the scale is kept.
    """
    first = min(model.cameras)
    origin = model.cameras[first].w2c
    depths = np.concatenate([model.depths(photo) for photo in model.cameras])
    scale = 1 / float(np.median(depths)) if len(depths) else 1.0
    cameras = {}
    for photo, camera in model.cameras.items():
        rotation = camera.w2c[:3, :3] @ origin[:3, :3].T
        w2c = np.eye(4)
        w2c[:3, :3] = rotation
        w2c[:3, 3] = scale * (camera.w2c[:3, 3] - rotation @ origin[:3, 3])
        cameras[photo] = replace(camera, w2c=w2c)
    # The products above leave rounding errors; the first pose is exact by definition.
    cameras[first] = replace(cameras[first], w2c=np.eye(4))
    points = scale * (model.points @ origin[:3, :3].T + origin[:3, 3])
    return replace(model, cameras=cameras, points=points)


def as_posed_views(model: SparseModel, photos: Sequence[Photo], max_size: int) -> PosedViews:
    """The photos that have a camera, undistorted to at most `max_size` pixels.

    The frame is that of `in_first_camera_frame`.
    """
    model = in_first_camera_frame(model)
    used = sorted(model.cameras)
    photo_cameras = tuple(model.cameras[i] for i in used)
    views, cameras = undistorted([photos[i] for i in used], photo_cameras, max_size=max_size)
    return PosedViews(
        views,
        cameras,
        points=torch.from_numpy(model.points).float(),
        visibility=tuple(torch.from_numpy(model.seen[i]) for i in used),
        keypoints=tuple(torch.from_numpy(model.pixels[i]).float() for i in used) if model.pixels else None,
        photo_cameras=photo_cameras,
    )
