"""Cameras that the user has already."""

from pathlib import Path

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.transforms import read_transforms


def read_known_cameras(path: Path) -> dict[str, PhotoCamera]:
    """Cameras by photo name from a transforms.json, a folder that holds one, or a COLMAP model folder.

    Raises QuerySplatError when there is neither.
    """
    if path.is_file():
        return read_transforms(path)
    if (path / "transforms.json").is_file():
        return read_transforms(path / "transforms.json")
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "colmap" / "sparse" / "0"):
        if any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt")):
            from querysplat_cli.scene.formats.colmap import read_colmap

            return read_colmap(folder)
    raise QuerySplatError(
        f"{path} holds no cameras", "Give a transforms.json, or a COLMAP model folder (cameras.bin or .txt)."
    )
