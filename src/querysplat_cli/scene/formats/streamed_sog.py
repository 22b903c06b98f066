"""PlayCanvas's streamed SOG, version 1: a folder of lod-meta.json and a SOG, not zipped, for each chunk of a level.

A viewer goes down the spatial tree in lod-meta.json, and loads each leaf at the level that suits its distance. Level 0
is the finest. A chunk is of one level, and holds whole leaves; within a leaf, Gaussians are in Morton order. What is
always shown, such as the backdrop, is the environment. Axes are those of the .ply.
"""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats import sog
from querysplat_cli.scene.formats.lod_tree import Division, extents, morton_codes, node
from querysplat_cli.scene.formats.ply import damage_named, finite_gaussians
from querysplat_cli.scene.formats.streamed_index import INDEX_NAME, INDEX_VERSION, StreamedIndex, read_index
from querysplat_cli.scene.gaussians import Gaussians, joined

ENVIRONMENT = "env"


@dataclass(frozen=True)
class Level:
    """The Gaussians of a level, and the leaf that each is in. Every leaf has one of each level at least."""

    gaussians: Gaussians
    leaf: Int[Tensor, "n"]


def write_streamed(
    folder: Path, levels: Sequence[Level], division: Division, environment: Gaussians | None, chunk: int
) -> None:
    """Write finite Gaussians into the empty `folder`, the finest level first.

    `division` has the leaves of the levels. A chunk has at most `chunk` Gaussians, or is one leaf.
    """
    leaves = int(levels[0].leaf.max()) + 1
    boxes = np.stack([np.full((leaves, 3), np.inf), np.full((leaves, 3), -np.inf)], 1)
    runs: list[dict[str, Any]] = [{} for _ in range(leaves)]
    names: list[str] = []
    for number, level in enumerate(levels):
        counts = torch.bincount(level.leaf, minlength=leaves).numpy()
        rows = np.lexsort((morton_codes(level.gaussians.means.double().numpy()), level.leaf.numpy()))
        ends = np.cumsum(counts)
        for place, part in enumerate(_chunks(counts, chunk)):
            start = ends[part[0]] - counts[part[0]]
            mine = torch.from_numpy(rows[start : ends[part[-1]]])
            stored = _write_chunk(folder / f"{number}_{place}", level.gaussians[mine])
            low, high = extents(stored)
            for leaf in part:
                offset = int(ends[leaf] - counts[leaf] - start)
                inside = slice(offset, offset + counts[leaf])
                boxes[leaf, 0] = np.minimum(boxes[leaf, 0], low[inside].min(0))
                boxes[leaf, 1] = np.maximum(boxes[leaf, 1], high[inside].max(0))
                runs[leaf][str(number)] = {"file": len(names), "offset": offset, "count": int(counts[leaf])}
            names.append(f"{number}_{place}/meta.json")
    sizes = [len(level.gaussians) for level in levels]
    meta: dict[str, Any] = {"version": INDEX_VERSION, "asset": {"generator": "querysplat"}}
    meta |= {"count": sum(sizes), "counts": sizes, "lodLevels": len(levels)}
    if environment is not None:
        _write_chunk(folder / ENVIRONMENT, environment)
        meta["environment"] = f"{ENVIRONMENT}/meta.json"
    meta |= {"filenames": names, "tree": node(division, boxes, runs)}
    (folder / INDEX_NAME).write_text(json.dumps(meta, separators=(",", ":")), encoding="utf-8")


def read_streamed(path: Path) -> Gaussians:
    """The Gaussians of the finest level and of the environment. `path` is the folder or its index.

    Raises QuerySplatError when something is missing, damaged or of another version.
    """
    _, gaussians = next(read_levels(path))
    return gaussians


def read_levels(path: Path) -> Iterator[tuple[int, Gaussians]]:
    """As `read_streamed` of each level, the finest first: its number of Gaussians, and these with the environment."""
    index_path = path / INDEX_NAME if path.is_dir() else path
    if not index_path.is_file():
        raise QuerySplatError(f"{index_path}: no such file", f"Give a folder with a {INDEX_NAME}.")
    folder = index_path.parent
    with damage_named(index_path, "streamed SOG"):
        index = read_index(index_path)
        if not index.counts:
            raise ValueError("it has no level")
        metas = [_meta(folder, name) for name in index.files]
        for name, meta, size in zip(index.files, metas, index.sizes, strict=True):
            if meta["count"] != size:
                raise ValueError(f"{name} has {meta['count']} Gaussians, and its leaves have {size}")
        around = None if index.environment is None else (index.environment, _meta(folder, index.environment))
        environment = [_chunk(folder, *around)] if around else []
    for level, count in enumerate(index.counts):
        with damage_named(index_path, "streamed SOG"):
            gaussians = joined(*_level(folder, index, metas, level), *environment)
        yield count, finite_gaussians(path, gaussians)


def _chunks(counts: Int[np.ndarray, "leaves"], most: int) -> Iterator[list[int]]:
    """Consecutive leaves that together have at most `most` Gaussians, one leaf at least."""
    part: list[int] = []
    for leaf in range(len(counts)):
        if part and counts[part].sum() + counts[leaf] > most:
            yield part
            part = []
        part.append(leaf)
    yield part


def _write_chunk(folder: Path, gaussians: Gaussians) -> Gaussians:
    """Write a SOG as files of a new folder, and return what readers find there."""
    meta, pictures = sog.encoded(gaussians)
    folder.mkdir()
    (folder / "meta.json").write_text(json.dumps(meta), encoding="utf-8")
    for name, pixels in pictures.items():
        (folder / name).write_bytes(sog.webp(pixels))
    return sog.decoded(meta, pictures.__getitem__)


def _level(folder: Path, index: StreamedIndex, metas: Sequence[dict[str, Any]], level: int) -> Iterator[Gaussians]:
    """The Gaussians of each chunk of a level."""
    ours = sorted((run for run in index.runs if run.level == level), key=lambda run: run.file)
    for number, runs in itertools.groupby(ours, key=lambda run: run.file):
        part = _chunk(folder, index.files[number], metas[number])
        for run in runs:
            means = part.means[run.offset : run.offset + run.count].double().numpy()
            if (means < run.box[0] - index.slack).any() or (means > run.box[1] + index.slack).any():
                raise ValueError(f"a Gaussian in {index.files[number]} lies outside the bound of its leaf")
        yield part


def _meta(folder: Path, name: PurePosixPath) -> dict[str, Any]:
    meta: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
    if meta["version"] != sog.VERSION:
        raise ValueError(f"{name} is of SOG version {meta['version']}, and only {sog.VERSION} is read")
    return meta


def _chunk(folder: Path, name: PurePosixPath, meta: dict[str, Any]) -> Gaussians:
    return sog.decoded(meta, partial(_picture, folder / name.parent))


def _picture(folder: Path, name: str) -> np.ndarray:
    if PurePosixPath(name).name != name:
        raise ValueError(f"{name!r} is not a file in its folder")
    return sog.unpacked((folder / name).read_bytes())
