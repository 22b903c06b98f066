"""How figures are shown and kept: Markdown tables, and JSON files with the machine's name."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from querysplat_cli.reporting.report import machine

__all__ = ["Table", "line", "machine", "markdown", "read_rows", "write_json", "write_rows"]


def line(cells: Iterable[object]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    return "\n".join(map(line, [head, ["---"] * len(head), *rows]))


class Table:
    """A Markdown table that is printed row by row while a benchmark runs."""

    def __init__(self, columns: Mapping[str, str]) -> None:
        """Print the head. `columns` gives the format of each column's cells by its heading."""
        self._formats = tuple(columns.values())
        print(markdown(list(columns), []), flush=True)

    def add(self, *cells: object) -> None:
        """Print a row; a cell that is None is printed as a dash."""
        pairs = zip(cells, self._formats, strict=True)
        print(line("–" if cell is None else format(cell, form) for cell, form in pairs), flush=True)


def write_json(path: Path | None, **parts: Any) -> None:
    """Write `parts` as one object, with dataclasses as objects. Nothing happens where `path` is None.

    The name of this machine stands beside them, unless they name another `machine`.
    """
    if path:
        path.write_text(json.dumps({"machine": machine(), **parts}, indent=2, default=_entries) + "\n")


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """The rows of a file that a benchmark goes on with, each with its `machine`; none where there is no file."""
    if not (path and path.is_file()):
        return []
    found = json.loads(path.read_text())
    return [{"machine": found["machine"], **row} for row in found["rows"]]


def write_rows(path: Path | None, rows: Sequence[Mapping[str, Any]]) -> None:
    """`write_json` of rows with their `machine`; those that have none were measured on this one."""
    write_json(path, machine="that of each row", rows=[{"machine": machine(), **row} for row in rows])


def _entries(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    raise TypeError(f"{type(value).__name__} has no place in a JSON file")
