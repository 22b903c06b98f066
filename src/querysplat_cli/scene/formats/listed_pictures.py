"""The pictures that a transforms.json lists: their files, and their sizes where the file states none."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from querysplat_cli.scene.decoding import upright_size
from querysplat_cli.scene.photos import PICTURE_FOLDERS, SUFFIXES


def inside(place: Traversable, part: str) -> Traversable:
    """The file or folder of this path in a folder, which may be one in a zip."""
    # A zip's paths have no empty parts and no "./".
    for step in (step for step in part.split("/") if step not in ("", ".")):
        place = place / step
    return place


def listed_picture(place: Traversable, path: str) -> Traversable | None:
    """The file of a listed frame, if it is there: as it is listed, or else with another suffix of pictures.

    NeRF's synthetic scenes list files without suffixes. Smaller copies are often PNG files where the list has JPEG.
    """
    stem = _stem(path)
    others = (stem + ending for suffix in sorted(SUFFIXES) for ending in (suffix, suffix.upper()))
    return next((file for name in (path, *others) if (file := inside(place, name)).is_file()), None)


def by_name(photos: Iterable[Path]) -> dict[str, list[Path]]:
    """The photos by their file names without suffixes."""
    found: dict[str, list[Path]] = {}
    for photo in photos:
        found.setdefault(_stem(photo.name), []).append(photo)
    return found


def with_size(
    frame: Mapping[str, Any], path: str, home: Traversable, photos: Mapping[str, Sequence[Path]]
) -> Mapping[str, Any]:
    """A frame with `w` and `h`: those of its picture where it states none and the picture can be read.

    The picture is looked for at `path` as written, in `home`, and in the folder of full-size pictures there. Where it
    is in none of these, those of the `photos` (`by_name`) that have its name count, if they are of one size.
    """
    if "w" in frame and "h" in frame:
        return frame
    root = Path("/") if path.startswith("/") and isinstance(home, Path) else home
    try:
        file = listed_picture(root, path) or listed_picture(inside(home, PICTURE_FOLDERS[0]), Path(path).name)
    except (OSError, ValueError):  # no path that a system has
        return frame
    sizes = {upright_size(each) for each in ([file] if file else photos.get(_stem(Path(path).name), []))}
    size = sizes.pop() if len(sizes) == 1 else None
    return {"h": size[0], "w": size[1], **frame} if size else frame


def _stem(path: str) -> str:
    """Without its suffix, if that is one of pictures."""
    return path.removesuffix(Path(path).suffix) if Path(path).suffix.lower() in SUFFIXES else path
