"""One hostile input."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REFUSED = frozenset({2, 3, 4})
ANY = REFUSED | {0}
QUIET = "-q"
WRITTEN = ("out", "out.ply", "out.json", "s", "s.ply")


@dataclass(frozen=True)
class Case:
    """One hostile input.

    `make(folder)` writes it into an empty folder. `command` is what then runs there. `codes` are the exit codes that
    are right. `written` are the names that a finished command may leave. `kind` says how it runs: in this process
    ("call"), in a process of its own with `place` around it ("process"), or killed after `place` ("kill").
    """

    family: str
    what: str
    make: Callable[[Path], object]
    command: tuple[str, ...]
    codes: frozenset[int] = ANY
    written: tuple[str, ...] = WRITTEN
    kind: str = "call"
    place: dict[str, Any] = field(default_factory=dict)


def several(files: Mapping[str, bytes]) -> Callable[[Path], object]:
    """Writes these files into the folder of a case."""

    def write(folder: Path) -> None:
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

    return write


def one_file(name: str, content: bytes) -> Callable[[Path], object]:
    """Writes this file into the folder of a case."""
    return several({name: content})
