"""Cameras that the user gives, matched with the photos by name."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from querysplat_cli.scene.cameras import PhotoCamera, same_shape
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.views import LeftOut, Photo


def match_cameras(
    photos: Sequence[Photo], given: Mapping[str, PhotoCamera]
) -> tuple[dict[int, PhotoCamera], list[LeftOut]]:
    """The given cameras by photo number, rotations made orthonormal, and the photos without a usable camera."""
    cameras, left_out = {}, []
    for number, photo in enumerate(photos):
        camera = given.get(photo.name)
        fault = _fault(photo, camera) if camera else "no camera is given for it"
        if camera and not fault:
            cameras[number] = replace(camera, w2c=rigid(camera.w2c))
        else:
            left_out.append(LeftOut(photo.name, fault))
    return cameras, left_out


def rigid(w2c: np.ndarray) -> np.ndarray:
    """The matrix [4, 4] with the nearest orthonormal rotation, in float64."""
    u, _, vt = np.linalg.svd(w2c[:3, :3])
    exact = np.array(w2c, dtype=np.float64)
    exact[:3, :3] = u @ vt
    return exact


def _fault(photo: Photo, camera: PhotoCamera) -> str:
    if not is_rigid(camera.w2c):
        return "its given camera is no rigid motion"
    if not same_shape((photo.height, photo.width), (camera.height, camera.width)):
        return f"it is {photo.width} × {photo.height}, its given camera {camera.width} × {camera.height}"
    return ""
