"""Triangulated points of structure from motion, and where photos observe them.

They are in points.safetensors of a scene folder, in the frame in which the scene was made.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from safetensors.torch import save
from scipy.sparse import csr_array
from torch import Tensor

from querysplat_cli.runtime.checkpoint_files import read_tensors
from querysplat_cli.runtime.errors import MAKE_AGAIN, QuerySplatError
from querysplat_cli.scene.photo_files import PhotoFile

NAME = "points.safetensors"


@dataclass(frozen=True)
class SparsePoints:
    """Points, and for each observation its view, its point and its pixel.

    Views count in the order of the scene's input cameras. Pixels are those of the photos in photos.json, distorted as
    the photos are, pixel centres at +0.5. A view observes a point at most once.
    """

    places: Float[Tensor, "n 3"]
    colours: UInt8[Tensor, "n 3"]
    view: Int[Tensor, "m"]
    point: Int[Tensor, "m"]
    pixels: Float[Tensor, "m 2"]

    def __len__(self) -> int:
        return len(self.places)


def shared_points(visibility: Sequence[Tensor], count: int) -> csr_array:
    """How many points each two views both see [views, views], and each view on the diagonal.

    `visibility` is for each view the row numbers of the points that it sees, of `count` points.
    """
    points = np.concatenate([np.zeros(0, np.int64), *map(np.asarray, visibility)])
    views = np.repeat(np.arange(len(visibility)), [len(rows) for rows in visibility])
    seen = csr_array((np.ones(len(points), np.int64), (views, points)), shape=(len(visibility), max(1, count)))
    return csr_array(seen @ seen.T)


def write_sparse_points(folder: Path, points: SparsePoints) -> None:
    """Write them into a scene folder."""
    tensors = {field.name: getattr(points, field.name).contiguous() for field in fields(points)}
    (folder / NAME).write_bytes(save(tensors))


def read_sparse_points(folder: Path, names: Sequence[str], photos: Mapping[str, PhotoFile]) -> SparsePoints | None:
    """Those of a scene folder whose input views have these names; None where it has none.

    `photos` are those of photos.json. Raises QuerySplatError when the file is damaged.
    """
    file = folder / NAME
    if not file.is_file():
        return None
    tensors, _ = read_tensors(file)
    fault = _fault(tensors, [photos.get(name) for name in names])
    if fault:
        raise QuerySplatError(f"{file} is damaged: {fault}", MAKE_AGAIN)
    return SparsePoints(**{field.name: tensors[field.name] for field in fields(SparsePoints)})


def _fault(tensors: dict[str, Tensor], photos: Sequence[PhotoFile | None]) -> str:
    """Why these are no points of a scene, or "".

    `photos` are those of its views; None stands for one that photos.json does not list.
    """
    if tensors.keys() != {field.name for field in fields(SparsePoints)}:
        return "it holds other tensors than those of points"
    n, m = len(tensors["places"]), len(tensors["view"])
    for name, (shape, kind) in {
        "places": ((n, 3), torch.float32),
        "colours": ((n, 3), torch.uint8),
        "view": ((m,), torch.int32),
        "point": ((m,), torch.int32),
        "pixels": ((m, 2), torch.float32),
    }.items():
        if tuple(tensors[name].shape) != shape or tensors[name].dtype != kind:
            return f"{name} has another shape or type"
    for name, count in (("view", len(photos)), ("point", n)):
        if m and not 0 <= int(tensors[name].min()) <= int(tensors[name].max()) < count:
            return f"{name} names a row that is not there"
    if not (tensors["places"].isfinite().all() and tensors["pixels"].isfinite().all()):
        return "a number is not finite"
    if _outside(tensors["pixels"], tensors["view"], photos).any():
        return "a pixel lies outside of its photo"
    pairs = tensors["view"].long() * n + tensors["point"]
    return "" if len(pairs.unique()) == m else "a view observes a point twice"


def _outside(pixels: Tensor, view: Tensor, photos: Sequence[PhotoFile | None]) -> Bool[Tensor, "m"]:
    """Which pixels lie more than one beyond the borders of their photo, where its size is known."""
    sizes = [(photo.width, photo.height) if photo else (math.inf, math.inf) for photo in photos]
    return ((pixels < -1) | (pixels > torch.tensor(sizes).reshape(-1, 2)[view] + 1)).any(1)
