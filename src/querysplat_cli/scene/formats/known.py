"""Cameras that the user already has, in any of the supported forms."""

from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.colmap import find_model, read_colmap
from querysplat_cli.scene.formats.transforms import read_transforms

JSON_NAMES = ("transforms.json", "cameras.json", "colmap/transforms.json", "nerfstudio/transforms.json")
"""Where nerfstudio, our scene folder and DL3DV keep the file."""

GAUSSIAN_KINDS = (".ply", ".spz", ".sog", ".glb")
"""Files that users take for a scene, whose cameras are in the folder beside them."""

MODEL_KINDS = (".bin", ".txt")
"""A file of such a kind stands for the COLMAP model in its folder."""


def read_known_cameras(path: Path, *, fisheye: bool = False) -> dict[str, PhotoCamera]:
    """Cameras by photo name from a transforms.json, a folder that holds one, or a COLMAP model's folder.

    With `fisheye`, those of fisheye lenses, too. Raises QuerySplatError when there are none, or they cannot be read.
    """
    source = find_known_cameras(path)
    return read_colmap(source, fisheye=fisheye) if source.is_dir() else read_transforms(source, fisheye=fisheye)


def find_known_cameras(path: Path) -> Path:
    """What `read_known_cameras` reads: a .json file, or the folder of a COLMAP model. Raises like it."""
    if not path.exists():
        raise QuerySplatError(f"{path}: no such file or folder", "Give a transforms.json or a COLMAP folder.")
    kind = path.suffix.lower()
    if path.is_file() and kind in GAUSSIAN_KINDS:
        raise QuerySplatError(f"{path} has Gaussians, and no cameras", "Give the folder of its scene.")
    if path.is_file() and kind not in (".json", *MODEL_KINDS):
        *kinds, last = GAUSSIAN_KINDS
        raise QuerySplatError(
            f"{path}: not a kind of file for cameras or Gaussians that is read",
            f"Cameras are a transforms.json or a COLMAP model, Gaussians a {', '.join(kinds)} or {last}.",
        )
    if path.is_file():
        return path if kind == ".json" else find_known_cameras(path.parent)
    listing = next((path / name for name in JSON_NAMES if (path / name).is_file()), None)
    found = listing or find_model(path)
    if found is None:
        parts = ", ".join(sorted(file.name for file in path.glob("transforms_*.json")))  # of NeRF's synthetic scenes
        raise QuerySplatError(
            f"{path}: neither a transforms.json nor a COLMAP model in it",
            f"Give one of its files: {parts}."
            if parts
            else "Give a transforms.json, or the folder with COLMAP's cameras and images files.",
        )
    return found
