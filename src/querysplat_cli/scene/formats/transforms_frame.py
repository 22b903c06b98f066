"""One frame of a transforms.json: its camera, in OpenCV's axes."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.cameras import PhotoCamera

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
LENS_MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
FISHEYE = "OPENCV_FISHEYE"
LENS_KEYS = {False: ("k1", "k2", "p1", "p2"), True: ("k1", "k2", "k3", "k4")}
"""The keys of a distortion, by whether the lens is a fisheye's."""
NEEDED = "Every frame needs w and h, or its picture where it says; fl_x or camera_angle_x; and a matrix."
RIGID_TOLERANCE = 1e-3
"""How far rounding in a file may move R·Rᵀ from the identity."""


def frame_camera(path: Path, name: str, frame: Mapping[str, Any], *, fisheye: bool = False) -> PhotoCamera:
    """One frame's camera; `frame` also has the settings that are common to the file.

    Raises QuerySplatError when it is incomplete, makes no sense, or has a lens that is not supported.
    """
    lens = frame.get("camera_model", "OPENCV")
    bent = fisheye and (lens == FISHEYE or bool(frame.get("is_fisheye")))
    further = [f"{key} {shown(frame[key])}" for key in ("k3", "k4", "is_fisheye") if frame.get(key)]
    if not bent and (lens not in LENS_MODELS or further):
        raise QuerySplatError(
            f"{path}: the lens of {name} is not one of OpenCV's with k1, k2, p1, p2 ({', '.join([lens, *further])})",
            "Undistort the photos first, for instance with `colmap image_undistorter`.",
        )
    try:
        width, height = _whole(frame, "w"), _whole(frame, "h")
        focal = _focal(frame, "x", width)
        rows = frame["transform_matrix"]
        if not all(type(number) in (int, float) for row in rows for number in row):
            raise ValueError("transform_matrix has other things than numbers")
        c2w = np.array(rows, dtype=np.float64)
        if c2w.shape not in ((4, 4), (3, 4)):
            raise ValueError("transform_matrix is not 4 × 4")
        k1, k2, k3, k4 = (_number(frame, key, 0.0) for key in LENS_KEYS[bent])
        with np.errstate(over="ignore", invalid="ignore"):
            w2c = opencv_from_opengl(np.vstack([c2w[:3], [0, 0, 0, 1]]))
        camera = PhotoCamera(
            w2c=w2c,
            focal=(focal, _focal(frame, "y", height, focal)),
            principal=(_number(frame, "cx", width / 2), _number(frame, "cy", height / 2)),
            distortion=(k1, k2, k3, k4),
            height=height,
            width=width,
            fisheye=bent,
        )
        if camera.fault():
            raise ValueError(camera.fault())
        return camera
    except KeyError as error:
        raise QuerySplatError(f"{path}: {name} has no {error}", NEEDED) from None
    except (TypeError, ValueError, ArithmeticError) as error:
        raise QuerySplatError(f"{path}: the camera of {name} makes no sense: {error}", "Export it again.") from None


def _focal(frame: Mapping[str, Any], axis: str, size: int, default: float | None = None) -> float:
    """The focal length in pixels: as it is stated, or that of the stated angle in radians that the picture spans."""
    angle = f"camera_angle_{axis}"
    if f"fl_{axis}" not in frame and angle in frame:
        return 0.5 * size / math.tan(0.5 * _number(frame, angle))
    return _number(frame, f"fl_{axis}", default)


def _number(frame: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = frame[key] if default is None else frame.get(key, default)
    if type(value) not in (int, float):
        raise ValueError(f"{key} is {shown(value)}, no number")
    return float(value)


def _whole(frame: Mapping[str, Any], key: str) -> int:
    value = _number(frame, key)
    if value != int(value):
        raise ValueError(f"{key} is {shown(value)}, no whole number")
    return int(value)


def opencv_from_opengl(c2w: np.ndarray) -> np.ndarray:
    """OpenCV world-to-camera [4, 4] of a rigid OpenGL camera-to-world [4, 4]."""
    return _rigid_inverse(c2w @ OPENGL_AXES)


def opengl_from_opencv(w2c: np.ndarray) -> np.ndarray:
    """The reverse of `opencv_from_opengl`."""
    return _rigid_inverse(w2c) @ OPENGL_AXES


def _rigid_inverse(matrix: np.ndarray) -> np.ndarray:
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def is_rigid(w2c: np.ndarray) -> bool:
    """Whether the matrix [4, 4] is finite and its rotation part is a rotation, within rounding."""
    rotation = w2c[:3, :3]
    if not np.isfinite(w2c).all():
        return False
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < RIGID_TOLERANCE and np.linalg.det(rotation) > 0)
