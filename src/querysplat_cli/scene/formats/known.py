"""Cameras that the user already has, in any of the supported forms."""

from collections.abc import Sequence
from pathlib import Path

import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.colmap import find_model, read_colmap
from querysplat_cli.scene.formats.llff import POSES_BOUNDS, SUFFIX, read_poses_bounds
from querysplat_cli.scene.formats.transforms import NamedCameras, as_named, read_cameras, read_transforms

JSON_NAMES = ("transforms.json", "cameras.json", "colmap/transforms.json", "nerfstudio/transforms.json")
"""Where nerfstudio, our scene folder and DL3DV keep the file."""

GAUSSIAN_KINDS = (".ply", ".spz", ".sog", ".glb")
"""Files that users take for a scene, whose cameras are in the folder beside them."""

MODEL_KINDS = (".bin", ".txt")
"""A file of such a kind stands for the COLMAP model in its folder."""


def read_known_cameras(path: Path, *, fisheye: bool = False, photos: Sequence[Path] = ()) -> dict[str, PhotoCamera]:
    """Cameras by photo name from a transforms.json or poses_bounds.npy, their folder, or a COLMAP model's folder.

    With `fisheye`, those of fisheye lenses, too. `photos` as for `read_transforms`. Raises QuerySplatError when there
    are none, or they cannot be read.
    """
    source = find_known_cameras(path)
    if source.is_dir():
        return read_colmap(source, fisheye=fisheye)
    return read_poses_bounds(source) if is_llff(source) else read_transforms(source, fisheye=fisheye, photos=photos)


def read_pinholes(path: Path) -> NamedCameras:
    """The cameras of what `find_known_cameras` gives, in float64 and without their distortion, held-out ones apart.

    Raises QuerySplatError as `read_known_cameras`, and for a matrix that is no rigid motion.
    """
    if not (path.is_dir() or is_llff(path)):
        return read_cameras(path, torch.float64)[0]
    cameras = read_known_cameras(path)
    return as_named(path, list(cameras), list(cameras.values()))


def is_llff(path: Path) -> bool:
    """Whether a file of cameras is LLFF's, by its name."""
    return path.suffix.lower() == SUFFIX


def find_known_cameras(path: Path) -> Path:
    """What `read_known_cameras` reads: a .json or .npy file, or the folder of a COLMAP model. Raises like it."""
    if not path.exists():
        raise QuerySplatError(f"{path}: no such file or folder", "Give a transforms.json or a COLMAP folder.")
    kind = path.suffix.lower()
    if path.is_file() and kind in GAUSSIAN_KINDS:
        raise QuerySplatError(f"{path} has Gaussians, and no cameras", "Give the folder of its scene.")
    if path.is_file() and kind not in (".json", SUFFIX, *MODEL_KINDS):
        *kinds, last = GAUSSIAN_KINDS
        raise QuerySplatError(
            f"{path}: not a kind of file for cameras or Gaussians that is read",
            f"Cameras are a transforms.json, a COLMAP model or a {POSES_BOUNDS}, "
            f"Gaussians a {', '.join(kinds)} or {last}.",
        )
    if path.is_file():
        return find_known_cameras(path.parent) if kind in MODEL_KINDS else path
    listing = next((path / name for name in JSON_NAMES if (path / name).is_file()), None)
    found = listing or find_model(path)
    if found is None and (path / POSES_BOUNDS).is_file():
        return path / POSES_BOUNDS
    if found is None:
        parts = ", ".join(sorted(file.name for file in path.glob("transforms_*.json")))  # of NeRF's synthetic scenes
        raise QuerySplatError(
            f"{path}: neither a transforms.json nor a COLMAP model in it",
            f"Give one of its files: {parts}."
            if parts
            else f"Give a transforms.json, a {POSES_BOUNDS}, or the folder with COLMAP's cameras and images files.",
        )
    return found
