"""Depth maps that come with photos: from a sensor such as LiDAR, or from a network.

A map holds camera z in any unit, and may have fewer pixels than its photo. The encoder finds the unit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.decoding import orientation_of
from querysplat_cli.scene.masks import QUARTER_TURNS
from querysplat_cli.scene.photo_names import path_parts
from querysplat_cli.scene.undistort import places_in_photo
from querysplat_cli.scene.views import Photo, PhotoSource

COLMAP = ".bin"
KINDS = (".npy", ".png", ".tif", ".tiff", f".geometric{COLMAP}", f".photometric{COLMAP}")
"""What names of maps end with. The first that exists counts: COLMAP's geometric maps have fewer wrong pixels."""
MILLIMETRE = 0.001
ONE_SURFACE = 0.1
"""Relative difference up to which the pixels around one are of its surface, and are interpolated."""
NAMES = "Maps are named a.png, a.npy, a.tif, a.jpg.png, a_depth.png or a.jpg.geometric.bin (COLMAP) for a.jpg."


def with_depth_maps(photos: Sequence[Photo], folder: Path | None, listed: Mapping[str, Path]) -> list[Photo]:
    """The photos with the depth maps of `folder`; None: those that are `listed` by photo name, where they exist.

    In `folder`, maps may lie in folders as their photos do. Raises QuerySplatError where the folder has none, where a
    map may be that of photos in several folders, and where it cannot be read or has another shape than its photo. Views
    of panoramas and frames of films have none.
    """
    if folder and not folder.is_dir():
        raise QuerySplatError(f"--depth-maps {folder}: no such folder", "Give the folder of the depth maps.")
    found = []
    for photo in photos:
        whole = photo.view is None and photo.pts is None
        file = (_file_in(folder, photo.path) if folder else listed.get(photo.name)) if whole else None
        if file and file.is_file():
            depth_of_photo(file, photo.source, (photo.height, photo.width))
            photo = replace(photo, depth_map=file.absolute())
        found.append(photo)
    if folder and all(photo.depth_map is None for photo in found):
        raise QuerySplatError(f"--depth-maps {folder}: no map of any of the {len(found)} photos in it", NAMES)
    if folder:
        _check_owners(folder, found)
    return found


def _file_in(folder: Path, photo: Path) -> Path | None:
    """The map of a photo: in the folders that mirror most of the photo's own, or else in `folder` itself."""
    names = [f"{start}{kind}" for start in (f"{photo.stem}_depth", photo.name, photo.stem) for kind in KINDS]
    own = path_parts(photo)[:-1]
    places = (folder.joinpath(*own[start:]) for start in range(len(own) + 1))
    files = (place / name for place in places if place.is_dir() for name in names)
    return next((file for file in files if file.is_file() and not file.samefile(photo)), None)


def _check_owners(folder: Path, photos: Sequence[Photo]) -> None:
    """Raise QuerySplatError where photos in several folders have one map: it shows what one of them shows."""
    owners: dict[Path, Photo] = {}
    for photo in photos:
        if photo.depth_map is None:
            continue
        other = owners.setdefault(photo.depth_map, photo)
        if other.path.parent != photo.path.parent:
            file = photo.depth_map.relative_to(folder.absolute())
            why = f"--depth-maps {folder}: {file} may belong to {other.name} or to {photo.name}"
            raise QuerySplatError(why, "Put the maps into folders with the names of those of the photos.")


def depth_of_photo(file: Path, source: PhotoSource, size: tuple[int, int]) -> Float[np.ndarray, "rows columns"]:
    """The map of an upright photo of `size` (height, width): camera z; 0 where it has none.

    The unit is a metre where whole numbers are millimetres and others metres, as sensors write them.
    Maps are upright, or turned as the stored pixels of the photo. Raises QuerySplatError where there is no such map.
    """
    depth = _read(file)
    if not same_shape(depth.shape, size):
        depth = np.rot90(depth, QUARTER_TURNS.get(orientation_of(source.path), 0))
    if not same_shape(depth.shape, size):
        shapes = f"{depth.shape[1]} × {depth.shape[0]} pixels, another shape than {source.path.name}"
        raise QuerySplatError(f"{file}: a depth map of {shapes}", "Give maps that show what the photos show.")
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _read(file: Path) -> np.ndarray:
    hint = "Depth maps are 16-bit PNG, float TIFF, .npy of numbers, [height, width], or COLMAP's .bin."
    try:
        if file.suffix.lower() == ".npy":
            depth = np.load(file, allow_pickle=False)
        elif file.suffix.lower() == COLMAP:
            depth = _colmap_map(file)
        else:
            depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, EOFError, cv2.error):
        depth = None
    if depth is None:
        raise QuerySplatError(f"{file}: this depth map cannot be read", hint)
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.dtype.kind not in "fiu" or depth.dtype.itemsize == 1:
        kind = " × ".join(map(str, depth.shape)) + f" of {depth.dtype}"
        raise QuerySplatError(f"{file}: no depth map ({kind})", hint)
    return depth * (MILLIMETRE if depth.dtype.kind in "iu" else 1.0)


def _colmap_map(file: Path) -> np.ndarray:
    """A map of COLMAP's dense workspaces, [height, width]. Raises ValueError where the file is none, or is cut off."""
    *header, pixels = file.read_bytes().split(b"&", 3)
    width, height, channels = map(int, header)
    if channels != 1 or min(width, height) < 1:
        raise ValueError("no depth map")
    return np.frombuffer(pixels, "<f4").reshape(height, width)


def depth_of_view(
    depth: Float[np.ndarray, "rows columns"], photo: PhotoCamera, K: Float[np.ndarray, "3 3"], size: tuple[int, int]
) -> Float[np.ndarray, "height width"]:
    """What a view without distortion sees of a photo's depth map; 0 where that is nothing.

    `photo` is the photo's camera, and `K` that of the view, of `size` (height, width). Within a surface, inverse depth
    is interpolated. At edges the nearest pixel counts, since a mean of both sides lies on neither.
    """
    maps = places_in_photo(rescaled(photo, *depth.shape), K, *size)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    smooth = of_one_surface(inverse, 3, ONE_SURFACE)
    nearest, mean, within = (
        cv2.remap(values, *maps, how, borderMode=cv2.BORDER_REPLICATE)
        for values, how in (
            (inverse, cv2.INTER_NEAREST),
            (inverse, cv2.INTER_LINEAR),
            (smooth.astype(np.float32), cv2.INTER_NEAREST),
        )
    )
    seen = np.where(within > 0, mean, nearest)
    return np.divide(1, seen, out=np.zeros_like(seen), where=seen > 0)


def of_one_surface(
    inverse: Float[np.ndarray, "height width"], side: int, step: float
) -> Bool[np.ndarray, "height width"]:
    """Where inverse depths in a square of `side` pixels are known (not 0) and differ by a share of at most `step`."""
    square = np.ones((side, side))
    highest, lowest = cv2.dilate(inverse, square), cv2.erode(inverse, square)
    return np.asarray((lowest > 0) & (highest <= (1 + step) * lowest))
