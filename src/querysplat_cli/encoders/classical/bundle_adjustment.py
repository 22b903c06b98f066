"""The final bundle adjustment: all cameras, points and lenses at once, with a robust loss and priors on the lenses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.least_squares import (
    Bundle,
    Loss,
    Observations,
    adjust,
    place_points,
    project,
)
from querysplat_cli.encoders.classical.lens_prior import ExpectedFocal, as_photo_camera, lens_prior
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel


def bundle_adjusted(
    model: pycolmap.Reconstruction, stated: Sequence[float | None], expected: Sequence[ExpectedFocal]
) -> SparseModel:
    """The model after a maximum a posteriori bundle adjustment.

    `stated` holds EXIF's focal length of each photo in pixels, or None, and `expected` what is to be expected without.
    Most features scatter by 0.2 px, but some are wrong by pixels. Under a squared loss those would bend the focal
    length, which a handful of photos of a shallow scene hardly determine. What the photos do not determine, the priors
    do: on the focal length, on the principal point, and on the two distortion terms. Poses and lenses follow from the
    longest tracks of each photo; then all points are placed.
    """
    policy = CAMERA_POLICY
    numbers = sorted(image - 1 for image in model.reg_image_ids())
    lens_numbers = sorted({model.images[photo + 1].camera_id for photo in numbers})
    bundle, seen = _bundle(model, numbers, lens_numbers)
    sizes = [(model.cameras[lens].height, model.cameras[lens].width) for lens in lens_numbers]
    # The first photo of each lens: photos of one lens state the same of it.
    first = [numbers[place] for place in np.unique(bundle.lens_of, return_index=True)[1]]
    prior = lens_prior(sizes, [stated[photo] for photo in first], [expected[photo] for photo in first])
    chosen = _longest(seen, len(bundle.points))
    points, rows = np.unique(seen.point[chosen], return_inverse=True)
    thin = Observations(seen.pixels[chosen], seen.camera[chosen], rows)
    loss = Loss(policy.adjustment_loss_scale, min(1.0, policy.independent_observations / max(len(chosen), 1)))
    adjusted = adjust(replace(bundle, points=bundle.points[points]), thin, prior, loss)
    everything = bundle.points.copy()
    everything[points] = adjusted.points
    bundle = place_points(replace(adjusted, points=everything), seen, loss)
    return _sparse_model(bundle, seen, numbers, sizes)


def _bundle(
    model: pycolmap.Reconstruction, numbers: Sequence[int], lens_numbers: Sequence[int]
) -> tuple[Bundle, Observations]:
    """The model as arrays, without the observations of points behind their cameras."""
    row = {point: i for i, point in enumerate(sorted(model.points3D))}
    pixels, camera, point = [], [], []
    for place, photo in enumerate(numbers):
        for observed in model.images[photo + 1].get_observation_points2D():
            pixels.append(observed.xy)
            camera.append(place)
            point.append(row[observed.point3D_id])
    seen = Observations(np.array(pixels).reshape(-1, 2), np.array(camera, np.int64), np.array(point, np.int64))
    bundle = Bundle(
        np.array([model.images[photo + 1].cam_from_world().matrix() for photo in numbers]),
        np.array([lens_numbers.index(model.images[photo + 1].camera_id) for photo in numbers]),
        np.array([_lens(model.cameras[lens]) for lens in lens_numbers]),
        np.array([model.points3D[point].xyz for point in row]).reshape(-1, 3),
    )
    front = project(bundle, seen)[1] > 0
    return bundle, Observations(seen.pixels[front], seen.camera[front], seen.point[front])


def _lens(camera: pycolmap.Camera) -> list[float]:
    k1 = next(float(camera.params[i]) for i in camera.extra_params_idxs())
    return [float(np.log(camera.focal_length)), camera.principal_point_x, camera.principal_point_y, k1, 0.0]


def _longest(seen: Observations, points: int) -> np.ndarray:
    """The observations of the points with the longest tracks of each photo, few enough to be quick."""
    length = np.bincount(seen.point, minlength=points)
    photos = int(seen.camera.max(initial=-1)) + 1
    most = CAMERA_POLICY.adjusted_observations // max(photos, 1)
    order = np.lexsort((seen.point, -length[seen.point], seen.camera))
    rank = np.arange(len(order)) - np.searchsorted(seen.camera[order], np.arange(photos))[seen.camera[order]]
    kept = np.zeros(points, bool)
    kept[seen.point[order[rank < most]]] = True
    return np.flatnonzero(kept[seen.point])


def _sparse_model(
    bundle: Bundle, seen: Observations, numbers: Sequence[int], sizes: Sequence[tuple[int, int]]
) -> SparseModel:
    """The bundle by photo number. `sizes` are (height, width) of the photos of each lens."""
    cameras = {}
    for photo, pose, lens in zip(numbers, bundle.poses, bundle.lens_of, strict=True):
        cameras[photo] = as_photo_camera(pose, bundle.lenses[lens], sizes[lens])
    observed, rows = np.unique(seen.point, return_inverse=True)
    visible, pixels = {}, {}
    for place, photo in enumerate(numbers):
        own = seen.camera == place
        visible[photo], first = np.unique(rows[own], return_index=True)
        pixels[photo] = seen.pixels[own][first]
    return SparseModel(cameras, bundle.points[observed], visible, pixels)
