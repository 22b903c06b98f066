"""Cameras of photos that EXIF's orientation turns. We read photos upright, and COLMAP reads them as stored."""

from dataclasses import replace

import numpy as np

from querysplat_cli.scene.cameras import PhotoCamera, same_shape
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.views import Photo

TURNS = {
    3: np.array([[-1.0, 0.0], [0.0, -1.0]]),
    6: np.array([[0.0, -1.0], [1.0, 0.0]]),
    8: np.array([[0.0, 1.0], [-1.0, 0.0]]),
}
"""For each EXIF orientation that turns, what it does to x (right) and y (down). 6 is a quarter turn clockwise."""
TURNS_BACK = {3: 3, 6: 8, 8: 6}
"""The orientation that undoes each of these."""
MIRRORED = {2, 4, 5, 7}
"""EXIF orientations that mirror. No camera sees a mirrored picture."""


def upright_camera(camera: PhotoCamera, photo: Photo | PhotoFile) -> PhotoCamera:
    """The camera for the upright pixels of a photo, where it was made for the pixels as stored; else itself.

    It was where its format says so, or where its shape does.
    """
    orientation = photo.orientation  # of a PhotoFile, this reads the file
    if orientation not in TURNS:
        return camera
    upright, given = (photo.height, photo.width), (camera.height, camera.width)
    stored = upright if orientation == 3 else upright[::-1]
    if same_shape(stored, given) and (camera.as_stored or not same_shape(upright, given)):
        return turned(camera, orientation)
    return camera


def stored_camera(camera: PhotoCamera, orientation: int) -> PhotoCamera:
    """The camera for the stored pixels, of one for the upright photo. It stays where EXIF turns nothing, or mirrors."""
    return turned(camera, TURNS_BACK[orientation]) if orientation in TURNS_BACK else camera


def stored_pixels(pixels: np.ndarray, height: int, width: int, orientation: int) -> np.ndarray:
    """Where pixels [k, 2] of an upright photo of `height` × `width` lie in the stored one."""
    if orientation not in TURNS_BACK:
        return pixels
    turn = TURNS[TURNS_BACK[orientation]]
    return pixels @ turn.T - _corner(turn, height, width)


def turned(camera: PhotoCamera, orientation: int) -> PhotoCamera:
    """The camera when the picture is turned as an EXIF orientation (3, 6 or 8) says."""
    turn = TURNS[orientation]
    whole = np.eye(4)
    whole[:2, :2] = turn
    corner = _corner(turn, camera.height, camera.width)
    width, height = np.abs(turn @ (camera.width, camera.height))
    fx, fy = np.abs(turn @ camera.focal)
    cx, cy = turn @ camera.principal - corner
    distortion = camera.distortion
    if not camera.fisheye:
        k1, k2, p1, p2 = distortion
        p2, p1 = turn @ (p2, p1)  # the tangential part is a vector of the picture
        distortion = k1, k2, float(p1), float(p2)
    return replace(
        camera, w2c=whole @ camera.w2c, focal=(float(fx), float(fy)), principal=(float(cx), float(cy)),
        distortion=distortion, height=round(height), width=round(width), as_stored=False,
    )  # fmt: skip


def _corner(turn: np.ndarray, height: int, width: int) -> np.ndarray:
    """The corner of a turned picture. Corners go to corners, so it is the lowest of the turned ones."""
    return np.minimum(turn @ (width, height), 0)
