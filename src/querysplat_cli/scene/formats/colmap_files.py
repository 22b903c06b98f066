"""The structure of COLMAP's binary files, checked before COLMAP reads them.

COLMAP believes every count in a file. One wrong count makes it take all memory.
"""

import struct
from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError

PARAMETERS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
"""How many parameters a camera of each lens model has, in the order of COLMAP's numbers."""
COUNTS = tuple(PARAMETERS.values())


def unreadable(folder: Path, reason: str) -> QuerySplatError:
    """The error for a damaged model in `folder`."""
    return QuerySplatError(f"{folder}: no COLMAP model that can be read: {reason}", "Export it again.")


class _Torn(ValueError):
    """The file ends within a record, or has a number that COLMAP does not know."""


class _Reader:
    """Steps through the bytes of a file."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._place = 0

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def number(self, kind: str) -> int:
        self.skip(struct.calcsize(f"<{kind}"))
        return int(struct.unpack_from(f"<{kind}", self._content, self._place - struct.calcsize(f"<{kind}"))[0])

    def skip(self, count: int) -> None:
        if count > self.left:
            raise _Torn
        self._place += count

    def text(self) -> None:
        end = self._content.find(b"\0", self._place)
        if end < 0:
            raise _Torn
        self._place = end + 1


def check_binary(folder: Path) -> None:
    """Raise QuerySplatError unless every count in the binary files of the model in `folder` fits its file."""
    for name, record in RECORDS.items():
        file = folder / f"{name}.bin"
        if not file.is_file():
            continue
        reader = _Reader(file.read_bytes())
        try:
            for _ in range(reader.number("Q")):
                record(reader)
        except _Torn:
            raise unreadable(folder, f"{file.name} is damaged, or cut off") from None


def _camera(reader: _Reader) -> None:
    reader.skip(4)
    model = reader.number("i")
    reader.skip(16)
    if not 0 <= model < len(COUNTS):
        raise _Torn
    reader.skip(8 * COUNTS[model])


def _image(reader: _Reader) -> None:
    reader.skip(4 + 7 * 8 + 4)
    reader.text()
    reader.skip(24 * reader.number("Q"))


def _point(reader: _Reader) -> None:
    reader.skip(8 + 3 * 8 + 3 + 8)
    reader.skip(8 * reader.number("Q"))


def _rig(reader: _Reader) -> None:
    reader.skip(4)
    sensors = reader.number("I")
    if sensors:
        reader.skip(8)
    for _ in range(sensors - 1):
        reader.skip(8)
        if reader.number("B"):
            reader.skip(7 * 8)


def _frame(reader: _Reader) -> None:
    reader.skip(4 + 4 + 7 * 8)
    reader.skip(16 * reader.number("I"))


RECORDS = {"cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}
"""What steps over one record of each file."""
