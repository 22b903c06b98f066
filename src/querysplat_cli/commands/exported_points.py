"""The points of a COLMAP model that `convert` makes of a scene folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.pipeline.gaussian_files import file_of_scene, read_gaussians
from querysplat_cli.reporting.stored_report import backdrop_of
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.colmap import Observed
from querysplat_cli.scene.formats.point_cloud import PointCloud, points_of
from querysplat_cli.scene.formats.transforms import read_working_cameras
from querysplat_cli.scene.orientation import stored_pixels
from querysplat_cli.scene.photo_files import PhotoFile, read_photo_files
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.sparse_points import read_sparse_points


def observed_points(listing: Path, cameras: Mapping[str, PhotoCamera]) -> Observed | None:
    """The points of structure from motion of the scene whose cameras.json is `listing`, in the frame of that file.

    Their pixels are those of `cameras`. None where the scene has none. Raises QuerySplatError when they are damaged.
    """
    inputs, _, frame = read_working_cameras(listing)
    files = read_photo_files(listing.parent / "photos.json")
    points = read_sparse_points(listing.parent, inputs.names, files)
    if points is None or not all(name in files and name in cameras for name in inputs.names):
        return None
    places = (frame or Sim3.identity()).apply(points.places)
    pixels, rows = {}, {}
    for view, name in enumerate(inputs.names):
        own = points.view == view
        pixels[name] = _seen(points.pixels[own].double().numpy(), files[name], cameras[name])
        rows[name] = points.point[own].numpy()
    return Observed(PointCloud(places.numpy(), points.colours.numpy()), pixels, rows)


def _seen(pixels: np.ndarray, file: PhotoFile, camera: PhotoCamera) -> np.ndarray:
    """Pixels [k, 2] of an upright photo as those of its camera, which is for the photo as it is stored."""
    stored = stored_pixels(pixels, file.height, file.width, file.orientation)
    return stored * max(camera.height, camera.width) / max(file.height, file.width)


def points_without_photos(folder: Path) -> Observed | None:
    """The points of the Gaussians beside a scene folder, without the backdrop. No photo observes them."""
    file = file_of_scene(folder)
    if not file.is_file():
        return None
    gaussians = read_gaussians(file)
    return Observed(points_of(gaussians[: len(gaussians) - backdrop_of(folder, len(gaussians))]))


def points_entry(points: Observed | None) -> dict[str, Any]:
    """How many points there are, and how many observations of them; none for the centres of Gaussians."""
    if points is None:
        return {}
    return {"points": len(points.cloud), "observations": sum(map(len, points.rows.values()))}
