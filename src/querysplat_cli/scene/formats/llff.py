"""Cameras in LLFF's poses_bounds.npy, an array [photos, 17].

A row has a matrix [3, 5] and two depths, which are not read. The columns of the matrix are down, right and backward in
the world, the camera's place, and (height, width, focal length) in pixels. The rows are those of the photos, sorted by
name.
"""

from dataclasses import replace
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.listed_pictures import inside
from querysplat_cli.scene.formats.transforms_frame import frame_camera
from querysplat_cli.scene.photo_names import names_a_photo
from querysplat_cli.scene.photos import PICTURE_FOLDERS, SUFFIXES

SUFFIX = ".npy"
POSES_BOUNDS = "poses_bounds.npy"
COLUMNS = 17
FORM = f"LLFF's {POSES_BOUNDS} has a row of {COLUMNS} numbers for each photo in {PICTURE_FOLDERS[0]} beside it."


def read_poses_bounds(path: Path, *, home: Traversable | None = None) -> dict[str, PhotoCamera]:
    """Pinhole cameras by photo name: OpenCV world-to-camera, in the units and axes of the file's world.

    The photos are those in the first of `PICTURE_FOLDERS` in `home`, or those in `home`, which by default is the file's
    folder. As LLFF takes its cameras from COLMAP, they are for the pixels as stored. A matrix that is no rigid motion
    is passed on as it is.
    Raises QuerySplatError when the file is damaged or has another shape, when there are more or fewer photos than
    rows, and for a camera that makes no sense.
    """
    rows = _rows(path)
    folder, place, names = _photos(home or path.parent)
    if len(names) != len(rows):
        why = f"{path} has {len(rows)} cameras, and {place} has {len(names)} photos"
        raise QuerySplatError(why, FORM)
    cameras = {}
    for name, row in zip(names, rows, strict=True):
        down, right, backward, centre, (height, width, focal) = row[:15].reshape(3, 5).T
        opengl = np.stack([right, -down, backward, centre], 1)
        frame = {"h": float(height), "w": float(width), "fl_x": float(focal), "transform_matrix": opengl.tolist()}
        cameras[name] = replace(frame_camera(path, name, frame), file=f"{folder}{name}", as_stored=True)
    return cameras


def _rows(path: Path) -> np.ndarray:
    """The array [photos, 17] in float64."""
    try:
        # Mapped, so that a header of far too many numbers takes no memory. Python's objects are never mapped.
        rows = np.lib.format.open_memmap(path, mode="r")
    except (OSError, ValueError, EOFError, OverflowError) as error:
        raise QuerySplatError(f"{path}: cannot be read as an array of numbers: {error}", FORM) from None
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind not in "fiu":
        shape = " × ".join(map(str, rows.shape))
        raise QuerySplatError(f"{path}: no cameras in it ({shape} of {rows.dtype})", FORM)
    return np.array(rows, np.float64)


def _photos(home: Traversable) -> tuple[str, Traversable, list[str]]:
    """The folder of the photos as names in `home` begin with it, the folder itself, and their names in LLFF's order."""
    folder = next((f"{name}/" for name in PICTURE_FOLDERS if (home / name).is_dir()), "")
    place = inside(home, folder)
    files = (file for file in place.iterdir() if Path(file.name).suffix.lower() in SUFFIXES and file.is_file())
    names = sorted(file.name for file in files if not file.name.startswith("."))
    if strange := [name for name in names if not names_a_photo(name)]:
        raise QuerySplatError(f"{place}: {shown(strange[0])} is no name of a photo", "Rename it.")
    return folder, place, names
