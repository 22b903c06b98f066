"""The lod-meta.json of a streamed SOG: what it says is checked, for it may be damaged, or of any program."""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from querysplat_cli.scene.formats.lod_tree import Box

INDEX_NAME = "lod-meta.json"
INDEX_VERSION = 1
BOUND_SLACK = 1e-3
"""Share of the largest coordinate of the scene, plus one, by which something may lie outside its bound: the 16 bits of
a coordinate are of a logarithm, and programs round bounds as they like."""


@dataclass(frozen=True)
class Run:
    """Consecutive Gaussians of a chunk: those of a leaf at a level. `box` is the bound of the leaf."""

    level: int
    file: int
    offset: int
    count: int
    box: Box


@dataclass(frozen=True)
class StreamedIndex:
    """What lod-meta.json says. Paths are relative to its folder. `counts` are of each level, `sizes` of each chunk."""

    counts: tuple[int, ...]
    files: tuple[PurePosixPath, ...]
    environment: PurePosixPath | None
    runs: tuple[Run, ...]
    sizes: tuple[int, ...]
    slack: float


def read_index(path: Path) -> StreamedIndex:
    """What the lod-meta.json at `path` says. Raises ValueError, and other errors of parsing, where it is damaged."""
    meta = json.loads(path.read_text(encoding="utf-8"))
    # Files of before the version was written have none.
    if meta.get("version", INDEX_VERSION) != INDEX_VERSION:
        raise ValueError(f"its version is {meta['version']}, and only version {INDEX_VERSION} is read")
    levels = _whole(meta["lodLevels"], "lodLevels")
    files = tuple(_inside(name) for name in meta["filenames"])
    if len(set(files)) < len(files):
        raise ValueError("it names a file twice")
    slack = BOUND_SLACK * (1 + float(np.abs(_box(meta["tree"])).max()))
    runs = tuple(_runs(meta["tree"], slack))
    counts = [0] * levels
    for run in runs:
        if run.level >= levels or run.file >= len(files):
            raise ValueError(f"a leaf refers to level {run.level} in file {run.file}, and there is no such one")
        counts[run.level] += run.count
    if meta.get("counts", counts) != counts or meta.get("count", sum(counts)) != sum(counts):
        raise ValueError(f"its leaves have {counts} Gaussians by level, and not as many as it says")
    environment = meta.get("environment")
    by_file: list[list[Run]] = [[] for _ in files]
    for run in runs:
        by_file[run.file].append(run)
    sizes = tuple(_size(number, ours) for number, ours in enumerate(by_file))
    return StreamedIndex(tuple(counts), files, _inside(environment) if environment else None, runs, sizes, slack)


def _runs(tree: dict[str, Any], slack: float) -> Iterator[Run]:
    """The runs of all leaves, from one end of the tree to the other."""
    waiting = [(tree, _box(tree))]
    while waiting:
        part, around = waiting.pop()
        box = _box(part)
        if (box[0] < around[0] - slack).any() or (box[1] > around[1] + slack).any():
            raise ValueError("the bound of a node does not lie in that of its parent")
        if ("children" in part) == ("lods" in part):
            raise ValueError("a node has both children and levels, or neither")
        waiting += [(child, box) for child in reversed(part.get("children", []))]
        for level, run in part.get("lods", {}).items():
            file, offset, count = (_whole(run[name], name) for name in ("file", "offset", "count"))
            yield Run(_whole(int(level), "a level"), file, offset, count, box)


def _size(number: int, runs: Sequence[Run]) -> int:
    """How many Gaussians a chunk has. Raises ValueError unless runs of one level cover it without a gap."""
    ours = sorted(runs, key=lambda run: (run.offset, run.count))
    ends = list(itertools.accumulate((run.count for run in ours), initial=0))
    if any(run.offset != start for run, start in zip(ours, ends, strict=False)):
        raise ValueError(f"the leaves do not cover file {number} exactly once")
    if len({run.level for run in ours}) > 1:
        raise ValueError(f"file {number} is of several levels")
    return ends[-1]


def _box(part: dict[str, Any]) -> Box:
    box = np.array([part["bound"]["min"], part["bound"]["max"]], np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
        raise ValueError("a bound is no box")
    return box


def _whole(value: object, name: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} is not a whole number from 0")
    return value


def _inside(name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or path.name == "":
        raise ValueError(f"{name!r} is not a file in its folder")
    return path
