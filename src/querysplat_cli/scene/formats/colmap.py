"""COLMAP models, read by pycolmap."""

from pathlib import Path

import numpy as np

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera

LENSES = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: ((f, f), (cx, cy), (0.0, 0.0, 0.0, 0.0)),
    "PINHOLE": lambda fx, fy, cx, cy: ((fx, fy), (cx, cy), (0.0, 0.0, 0.0, 0.0)),
    "SIMPLE_RADIAL": lambda f, cx, cy, k: ((f, f), (cx, cy), (k, 0.0, 0.0, 0.0)),
    "RADIAL": lambda f, cx, cy, k1, k2: ((f, f), (cx, cy), (k1, k2, 0.0, 0.0)),
    "OPENCV": lambda fx, fy, cx, cy, *k: ((fx, fy), (cx, cy), k),
}
"""COLMAP's parameters → focal, principal point, (k1, k2, p1, p2)."""


def read_colmap(folder: Path) -> dict[str, PhotoCamera]:
    """Cameras by photo name from a binary or text model.

    Raises QuerySplatError when the model cannot be read or its lens has no (k1, k2, p1, p2) form.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError, OSError) as error:
        raise QuerySplatError(f"{folder} is not a readable COLMAP model: {error}", "Export it again.") from error
    found = {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        camera = model.cameras[image.camera_id]
        kind = camera.model.name
        if kind not in LENSES:
            raise QuerySplatError(
                f"{folder}: lens model {kind} is not supported",
                f"Undistort the photos, or use one of {', '.join(LENSES)}.",
            )
        focal, principal, distortion = LENSES[kind](*camera.params)
        w2c = np.eye(4)
        w2c[:3] = image.cam_from_world().matrix()
        found[Path(image.name).name] = PhotoCamera(w2c, focal, principal, distortion, camera.height, camera.width)
    if not found:
        raise QuerySplatError(f"{folder} holds no registered photo", "Give a COLMAP model with poses.")
    return found
