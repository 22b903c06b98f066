"""COLMAP's text files: lines that COLMAP would read wrongly, and lines that are damaged."""

import re
from collections.abc import Iterator
from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.formats.colmap_files import PARAMETERS, unreadable

IMAGE_FIELDS = 10
"""Of a line of images.txt: number, quaternion, translation, camera, name."""

_WHOLE = r"[-+]?\d+"
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POSE = rf"{_NUMBER}(?: {_NUMBER}){{6}}"
_LENSES = "|".join(
    rf"{name} {_WHOLE} {_WHOLE}(?: {_NUMBER}){{{parameters}}}" for name, parameters in PARAMETERS.items()
)
_IMAGE = rf"{_WHOLE} {_POSE} {_WHOLE} .+"
_SEEN = rf"(?:{_NUMBER} {_NUMBER} {_WHOLE}(?: |$))*"
LINES = {
    "cameras": rf"{_WHOLE} (?:{_LENSES})",
    "images": rf"{_IMAGE}|{_SEEN}",
    "points3D": rf"{_WHOLE}(?: {_NUMBER}){{3}}(?: {_WHOLE}){{3}} {_NUMBER}(?: {_WHOLE} {_WHOLE})*",
    "rigs": rf"{_WHOLE} {_WHOLE}(?: [A-Z]+ {_WHOLE}(?: 0| 1 {_POSE})?)*",
    "frames": rf"{_WHOLE} {_WHOLE} {_POSE} {_WHOLE}(?: [A-Z]+ {_WHOLE} {_WHOLE})*",
}
"""What each line of each file is like, its fields joined by one space."""


def damage(folder: Path) -> str | None:
    """Which file of the text model in `folder` is empty, or which line is damaged, in words; None where none is."""
    for file, like in ((folder / f"{name}.txt", like) for name, like in LINES.items()):
        lines = [(number, fields) for number, fields in _lines(file) if fields] if file.is_file() else []
        for number, fields in lines:
            if not re.fullmatch(like, " ".join(fields)):
                return _damaged(file, number)
        if file.is_file() and not lines and file.stem != "points3D":  # a model may have no points
            return f"{file.name} is empty, or cut off"
    return None


def check_images(folder: Path) -> None:
    """Raise QuerySplatError where COLMAP would cut a name in images.txt at a space, or miss a photo."""
    file = folder / "images.txt"
    if not file.is_file():
        return
    lines = _lines(file)
    for number, fields in lines:
        if not fields:
            continue
        if not re.fullmatch(_IMAGE, " ".join(fields)):
            raise unreadable(folder, _damaged(file, number))
        if len(fields) > IMAGE_FIELDS:
            name = " ".join(fields[IMAGE_FIELDS - 1 :])
            raise QuerySplatError(
                f"{folder}: COLMAP cuts the name {shown(name)} in images.txt at its space",
                "Export the model as binary files.",
            )
        number, points = next(lines, (0, None))  # those that the photo shows, three numbers each
        if points is None:
            raise QuerySplatError(
                f"{folder}: images.txt ends at {shown(fields[-1])}, and COLMAP leaves that photo out",
                "Add an empty line at its end: each photo has two lines.",
            )
        if len(points) % 3 and re.fullmatch(_IMAGE, " ".join(points)):
            raise QuerySplatError(
                f"{folder}: the line after that of {shown(fields[-1])} in images.txt has no points, and is skipped",
                "Add an empty line behind each photo's: each photo has two lines.",
            )
        if len(points) % 3:
            raise unreadable(folder, _damaged(file, number))


def _damaged(file: Path, number: int) -> str:
    return f"line {number} of {file.name} is damaged, or cut off"


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    """The number of each line that is no comment, and its fields."""
    with file.open(errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            if not line.startswith("#"):
                yield number, line.split()
