"""Cameras as nerfstudio, DL3DV and instant-ngp write them: transforms.json, OpenGL camera-to-world."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.views import Views

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class NamedCameras:
    """Cameras with the names and sizes (height, width) of their pictures."""

    names: tuple[str, ...]
    cameras: Cameras
    sizes: tuple[tuple[int, int], ...]


def opengl_to_w2c(transform: np.ndarray) -> np.ndarray:
    """OpenCV world-to-camera [4, 4] of an OpenGL camera-to-world matrix; its own inverse, up to the inverse."""
    return np.linalg.inv(transform @ OPENGL_TO_OPENCV)


def read_transforms(path: Path) -> dict[str, PhotoCamera]:
    """Cameras by the photos' own names. Intrinsics may be per file or per frame.

    Raises QuerySplatError, naming the frame, for matrices that are no rigid motion.
    """
    document = _load(path)
    found = {}
    for frame in document.get("frames", []):
        name = Path(str(frame.get("file_path", ""))).name
        values = {**document, **frame}
        transform = np.array(frame.get("transform_matrix", []), dtype=float)
        if transform.shape != (4, 4) or not _rigid(transform):
            raise QuerySplatError(
                f"{path}: the matrix of frame {name} is no rigid motion", "Correct or remove that frame."
            )
        try:
            width, height = int(values["w"]), int(values["h"])
            focal = values.get("fl_x") or width / (2 * math.tan(values["camera_angle_x"] / 2))
            found[name] = PhotoCamera(
                w2c=opengl_to_w2c(transform),
                focal=(float(focal), float(values.get("fl_y") or focal)),
                principal=(float(values.get("cx", width / 2)), float(values.get("cy", height / 2))),
                distortion=tuple(float(values.get(key, 0)) for key in ("k1", "k2", "p1", "p2")),  # type: ignore[arg-type]
                height=height,
                width=width,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise QuerySplatError(
                f"{path}: frame {name} has no usable {error}", "A frame needs w, h, and fl_x or camera_angle_x."
            ) from error
    if not found:
        raise QuerySplatError(f"{path} lists no frames", "Give a nerfstudio or DL3DV transforms.json.")
    return found


def write_cameras(path: Path, cameras: Cameras, views: Views, heldout: tuple[Views, Cameras] | None = None) -> None:
    """Write pinhole cameras in nerfstudio's form; held-out views go under "heldout_frames"."""
    document = {"camera_model": "PINHOLE", "frames": _frames(cameras, views)}
    if heldout:
        document["heldout_frames"] = _frames(heldout[1], heldout[0])
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(document, indent=2) + "\n")


def read_cameras(path: Path) -> tuple[NamedCameras, NamedCameras | None]:
    """Input and held-out cameras of a cameras.json, or of any transforms.json without distortion.

    All share a canvas as large as the largest picture, in whole blocks of 12 pixels as the encoders make it.
    """
    document = _load(path)
    groups = [_named(path, document, document.get(key, [])) for key in ("frames", "heldout_frames")]
    if not groups[0]:
        raise QuerySplatError(f"{path} lists no frames", "Give the cameras.json of a scene folder.")
    height = max(size[0] for group in groups for _, _, _, size in group)
    width = max(size[1] for group in groups for _, _, _, size in group)
    canvas = (math.ceil(height / 12) * 12, math.ceil(width / 12) * 12)
    inputs, heldout = (
        NamedCameras(
            tuple(name for name, *_ in group),
            Cameras(
                torch.from_numpy(np.stack([w2c for _, w2c, _, _ in group])).float(),
                torch.from_numpy(np.stack([K for _, _, K, _ in group])).float(),
                *canvas,
            ),
            tuple(size for *_, size in group),
        )
        if group
        else None
        for group in groups
    )
    assert inputs is not None
    return inputs, heldout


def _named(
    path: Path, document: dict[str, Any], frames: list[dict[str, Any]]
) -> list[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]]:
    """(name, w2c, K, size) of each frame."""
    found = []
    for frame in frames:
        values = {**document, **frame}
        if any(values.get(key) for key in ("k1", "k2", "k3", "p1", "p2")):
            raise QuerySplatError(
                f"{path} has lens distortion", "Rendering needs pinhole cameras: undistort them first."
            )
        try:
            K = np.eye(3)
            K[0, 0], K[1, 1] = values["fl_x"], values.get("fl_y", values["fl_x"])
            size = (int(values["h"]), int(values["w"]))
            K[0, 2], K[1, 2] = values.get("cx", size[1] / 2), values.get("cy", size[0] / 2)
            w2c = opengl_to_w2c(np.array(values["transform_matrix"], dtype=float))
        except (KeyError, ValueError, np.linalg.LinAlgError) as error:
            raise QuerySplatError(
                f"{path}: a frame has no usable {error}", "A frame needs fl_x, w, h, transform_matrix."
            ) from error
        name = str(values["file_path"])
        found.append((name.removeprefix("images/"), w2c, K, size))
    return found


def _frames(cameras: Cameras, views: Views) -> list[dict[str, Any]]:
    frames = []
    for name, (height, width), w2c, K in zip(
        views.names, views.sizes, cameras.w2c.double().numpy(), cameras.K.double().numpy(), strict=True
    ):
        frames.append(
            {
                "file_path": f"images/{name}",
                "w": width,
                "h": height,
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2],
                "cy": K[1, 2],
                "transform_matrix": (np.linalg.inv(w2c) @ OPENGL_TO_OPENCV).tolist(),
            }
        )
    return frames


def _rigid(transform: np.ndarray) -> bool:
    rotation = transform[:3, :3]
    return bool(
        np.isfinite(transform).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
        and np.linalg.det(rotation) > 0
    )


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise QuerySplatError(f"{path} cannot be read: {error}", "Give a transforms.json.") from error
    if not isinstance(document, dict):
        raise QuerySplatError(f"{path} holds no camera list", "Give a transforms.json.")
    return document
