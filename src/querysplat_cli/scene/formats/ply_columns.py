"""The container of a .ply (Greg Turk's polygon format, 1994): the columns of its vertices, whatever they mean."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_HEADER = 1 << 22
"""Bytes of the longest header that is read: thousands of properties, and long comments."""
TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""NumPy's types by the words of the format."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
Columns = dict[str, np.ndarray]


class DamagedPly(ValueError):
    """The bytes are no .ply, or another one than its header says."""


class SurplusPly(DamagedPly):
    """There is more data than the header says."""


@dataclass(frozen=True)
class _Element:
    """`types` has NumPy's type of each property, and None where that is a list."""

    name: str
    count: int
    types: dict[str, str | None]

    @property
    def has_lists(self) -> bool:
        return None in self.types.values()


def read_columns(path: Path) -> Columns | None:
    """The columns of the element `vertex` by name, in the machine's byte order; None where there is no such element.

    Columns that are lists are left out. Raises DamagedPly, and OSError where the file cannot be read.
    """
    content = path.read_bytes()
    order, elements, body = _header(content)
    names = [element.name for element in elements]
    if "vertex" not in names:
        return None
    before, vertices = elements[: names.index("vertex")], elements[names.index("vertex")]
    if any(element.has_lists for element in (*before, vertices)):
        raise DamagedPly("it has lists among or in front of its vertices")
    fixed = not any(element.has_lists for element in elements)
    return (_binary if order else _text)(content[body:], order, [*before, vertices], elements if fixed else None)


def write_columns(path: Path, columns: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write float32 columns of one length as the vertices of a binary little-endian .ply."""
    rows = np.stack([np.asarray(column, "<f4") for column in columns.values()], 1)
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += [f"element vertex {len(rows)}", *(f"property float {name}" for name in columns), "end_header"]
    with path.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode("ascii", "replace"))
        stream.write(rows.tobytes())


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """The byte order (empty for text), the elements, and where the data begins."""
    end = re.compile(rb"^end_header[ \t]*(\r\n|\n|\r)", re.MULTILINE).search(content[:MOST_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise DamagedPly("it has no header")
    order, elements = None, list[_Element]()
    for line in content[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", word, "1.0"] if word in ORDERS:
                order = ORDERS[word]
            case ["element", name, count]:
                elements.append(_Element(name, _whole(count), {}))
            case ["property", "list", counts, items, name] if elements and {counts, items} <= TYPES.keys():
                _add(elements[-1], name, None)
            case ["property", word, name] if elements and word in TYPES:
                _add(elements[-1], name, TYPES[word])
            case ["ply"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise DamagedPly(f"its header has the line {line[:40]!r}")
    if order is None:
        raise DamagedPly("its header names no format that is known")
    if len({element.name for element in elements}) < len(elements):
        raise DamagedPly("its header names an element twice")
    return order, elements, end.end()


def _whole(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 19):
        raise DamagedPly(f"its header counts {text[:20]!r} of an element")
    return int(text)


def _add(element: _Element, name: str, kind: str | None) -> None:
    if name in element.types:
        raise DamagedPly(f"its header names {name[:40]!r} twice")
    element.types[name] = kind


def _binary(data: bytes, order: str, first: Sequence[_Element], every: Sequence[_Element] | None) -> Columns:
    """The columns of the last element of `first`. `every` element of the file tells the size; None with lists."""
    types = [np.dtype([(name, f"{order}{kind}") for name, kind in element.types.items()]) for element in first]
    sizes = [kind.itemsize * element.count for kind, element in zip(types, first, strict=True)]
    if len(data) < sum(sizes):
        raise DamagedPly("it is cut off")
    if every:
        rest = [np.dtype(list(element.types.items())).itemsize * element.count for element in every[len(first) :]]
        _check_size(len(data), sum(sizes) + sum(rest))
    rows = np.frombuffer(data, types[-1], first[-1].count, sum(sizes[:-1]))
    return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in first[-1].types}


def _text(data: bytes, order: str, first: Sequence[_Element], every: Sequence[_Element] | None) -> Columns:
    """As `_binary`, of numbers in words."""
    words = data.split()
    counts = [len(element.types) * element.count for element in first]
    if len(words) < sum(counts):
        raise DamagedPly("it is cut off")
    if every:
        _check_size(len(words), sum(len(element.types) * element.count for element in every))
    wanted = np.array(words[sum(counts[:-1]) : sum(counts)], dtype=np.float64)
    rows = wanted.reshape(first[-1].count, len(first[-1].types))
    return {name: rows[:, i] for i, name in enumerate(first[-1].types)}


def _check_size(found: int, expected: int) -> None:
    if found < expected:
        raise DamagedPly("it is cut off")
    if found > expected:
        raise SurplusPly("it holds more data than its header says")
