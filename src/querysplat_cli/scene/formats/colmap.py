"""Cameras of a COLMAP model: cameras, images and points3D as .bin or .txt."""

from pathlib import Path

import numpy as np

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.photos import short_names

MODEL_FOLDERS = ("", "0", "sparse", "sparse/0", "colmap/sparse/0")
"""Where a model may lie in a folder that the user names."""
DISTORTION = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0, 1),
    "OPENCV": (0, 1, 2, 3),
}
"""For each lens model, which of OpenCV's (k1, k2, p1, p2) its extra parameters are."""


def find_model(folder: Path) -> Path | None:
    """The folder with a COLMAP model in or under `folder`."""
    places = [folder / name for name in MODEL_FOLDERS]
    return next((place for place in places if any(map(Path.is_file, _model_files(place)))), None)


def read_colmap(folder: Path) -> dict[str, PhotoCamera]:
    """Cameras by photo name (with its folder only where names repeat) of the model in `folder`.

    Raises QuerySplatError when the model is damaged, or a lens has more than k1, k2, p1, p2.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError, IndexError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise QuerySplatError(f"{folder}: no COLMAP model that can be read: {reason}", "Export it again.") from error
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    if not images:
        raise QuerySplatError(f"{folder}: the COLMAP model places no photo", "Give another model.")
    names = short_names([Path(image.name) for image in images])
    cameras = {}
    for name, image in zip(names, images, strict=True):
        camera = model.cameras[image.camera_id]
        if camera.model_name not in DISTORTION:
            raise QuerySplatError(
                f"{folder}: the lens of {name} is {camera.model_name}; known are {', '.join(DISTORTION)}",
                "Undistort the photos first, with `colmap image_undistorter`.",
            )
        w2c = np.eye(4)
        w2c[:3] = image.cam_from_world().matrix()
        distortion = [0.0, 0.0, 0.0, 0.0]
        for place, index in zip(DISTORTION[camera.model_name], camera.extra_params_idxs(), strict=True):
            distortion[place] = float(camera.params[index])
        k1, k2, p1, p2 = distortion
        cameras[name] = PhotoCamera(
            w2c=w2c,
            focal=(float(camera.focal_length_x), float(camera.focal_length_y)),
            principal=(float(camera.principal_point_x), float(camera.principal_point_y)),
            distortion=(k1, k2, p1, p2),
            height=int(camera.height),
            width=int(camera.width),
        )
    return cameras


def _model_files(folder: Path) -> list[Path]:
    return [folder / f"images{suffix}" for suffix in (".bin", ".txt")]
