"""The tensors of a scene folder: written by name, and checked before anything uses them.

Their names, shapes and types are those of the dataclasses that they belong to.
"""

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.model.anchors import Anchors, Neighbours, Reading
from querysplat_cli.model.memories import Memories
from querysplat_cli.queries.prepare import NOT_KNOWN, MemoryMap

HALF = {"map.depth", "anchors.reading.geometry", "anchors.reading.appearance"}
"""Tensors that a new scene has in half precision, and that stay as they are when it is written again."""


class DamagedTensors(ValueError):
    """The tensors are not those of a scene. The text says which one is wrong."""


@dataclass(frozen=True)
class StoredTensors:
    """What memories.safetensors holds.

    `masks` are those of the input views, then those of the held-out views. `kept` marks the decoded Gaussians that
    belong to the scene (None: all). Of a scene that was joined from regions, memories and anchors have no row.
    """

    masks: Bool[Tensor, "views height width"]
    memories: Memories
    anchors: Anchors | None = None
    kept: Bool[Tensor, "n"] | None = None
    map: MemoryMap | None = None


def flattened(stored: StoredTensors) -> dict[str, Tensor]:
    """The tensors by the names that they have in the file."""
    flat: dict[str, Tensor] = {}
    for field in fields(stored):
        part = getattr(stored, field.name)
        flat |= {} if part is None else _flatten(field.name, part)
    return flat


def checked(tensors: dict[str, Tensor], inputs: int, views: int, canvas: tuple[int, int]) -> StoredTensors:
    """The inverse of `flattened` for a scene of so many `inputs` and `views` (held-out ones included).

    `canvas` is (height, width) in pixels. Raises DamagedTensors where a tensor is missing, has another type or shape,
    is not finite, or names a row that is not there: compiled kernels read the rows without a look at their bounds.
    """
    sizes = {"views": views, "height": canvas[0], "width": canvas[1]}
    masks = _read("masks", Bool[Tensor, "views height width"], tensors, sizes)
    memories: Memories = _part(Memories, "memories", tensors)
    means = tensors.get("anchors.means", torch.zeros(0, 0))
    # Scenes of earlier versions have none of these.
    reading = _flatten("anchors.reading", Reading.none(len(means)))
    tensors = {"anchors.refinement": torch.zeros(*means.shape[:2], 0), **reading, "map.confirmed": NOT_KNOWN, **tensors}
    anchors: Anchors | None = _part(Anchors, "anchors", tensors) if "anchors.means" in tensors else None
    if anchors is not None:
        _check_anchors(anchors, memories, inputs)
    kept = _read("kept", Bool[Tensor, "n"], tensors, {}) if "kept" in tensors else None
    if kept is not None and anchors is not None and len(kept) != anchors.opacities.numel():
        raise DamagedTensors(f"kept marks {len(kept)} Gaussians, and the anchors have {anchors.opacities.numel()}")
    where: MemoryMap | None = _part(MemoryMap, "map", tensors) if "map.grid" in tensors else None
    if where is not None:
        _check_map(where, memories, inputs, canvas)
    return StoredTensors(masks, memories, anchors, kept, where)


def _flatten(name: str, part: Any) -> dict[str, Tensor]:
    """A dataclass of tensors and of such dataclasses, as named tensors."""
    if not is_dataclass(part):
        return {name: part.detach().contiguous().clone()}
    flat: dict[str, Tensor] = {}
    for field in fields(part):
        flat |= _flatten(f"{name}.{field.name}", getattr(part, field.name))
    return flat


def _part(kind: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    sizes: dict[str, int] = {}
    parts = {}
    for field in fields(kind):
        inner = f"{name}.{field.name}"
        parts[field.name] = (
            _part(field.type, inner, tensors) if is_dataclass(field.type) else _read(inner, field.type, tensors, sizes)
        )
    return kind(**parts)


def _read(name: str, kind: Any, tensors: dict[str, Tensor], sizes: dict[str, int]) -> Tensor:
    """One tensor of the jaxtyping annotation `kind`, floats as float32 but for those of `HALF`.

    `sizes` has the lengths of the axes that are known already, and gets the new ones.
    """
    tensor = tensors.get(name)
    if tensor is None:
        raise DamagedTensors(f"the tensor {name} is missing")
    axes = kind.dim_str.split()
    fits = str(tensor.dtype).removeprefix("torch.") in kind.dtypes and tensor.ndim == len(axes)
    for axis, length in zip(axes, tensor.shape, strict=False):
        fits &= length == (int(axis) if axis.isdecimal() else sizes.setdefault(axis, length))
    if not fits:
        found = f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
        raise DamagedTensors(f"the tensor {name} is {found}, and not {kind.__name__}")
    if tensor.is_floating_point():
        if not tensor.isfinite().all():
            raise DamagedTensors(f"the tensor {name} has numbers that are not finite")
        tensor = tensor if name in HALF else tensor.float()
    return tensor


def _check_anchors(anchors: Anchors, memories: Memories, views: int) -> None:
    rows = {
        "geometry": len(memories.geometry_keys),
        "appearance": len(memories.appearance_keys),
        "queries": len(anchors),
    }
    for name, count in rows.items():
        near: Neighbours = getattr(anchors, name)
        if len(near.index) != len(anchors) or near.index.dtype != torch.int64:
            raise DamagedTensors(f"the tensor anchors.{name}.index has not one row of int64 for each query")
        _check_rows(f"anchors.{name}.index", near.index, count)
    if len(anchors.reading.views) != len(anchors):
        raise DamagedTensors("the tensor anchors.reading.views has not one row for each query")
    _check_rows("anchors.reading.views", anchors.reading.views, views)
    for name in ("scales", "spacing"):
        if not (getattr(anchors, name) > 0).all():
            raise DamagedTensors(f"the tensor anchors.{name} has lengths that are not positive")
    # Colours have no such limits: means of a white sky are 1 + 1e-7.
    if not ((anchors.opacities >= 0) & (anchors.opacities <= 1)).all():
        raise DamagedTensors("the tensor anchors.opacities has numbers outside 0 to 1")
    if not len(anchors) and len(memories.geometry_keys):
        raise DamagedTensors("there is no query")


def _check_map(where: MemoryMap, memories: Memories, inputs: int, canvas: tuple[int, int]) -> None:
    special, rows, columns = where.layout
    if not (special >= 0 and 0 < rows <= canvas[0] and 0 < columns <= canvas[1]):
        raise DamagedTensors(f"the tensor map.grid is {where.grid.tolist()}")
    _check_rows("map.geometry_rows", where.geometry_rows, inputs * (special + rows * columns))
    _check_rows("map.appearance_rows", where.appearance_rows, inputs * canvas[0] * canvas[1])
    for name, keys in (("geometry", memories.geometry_keys), ("appearance", memories.appearance_keys)):
        if len(getattr(where, f"{name}_rows")) != len(keys):
            raise DamagedTensors(f"the tensor map.{name}_rows has not one row for each of {len(keys)} memory rows")
    for name in ("depth", "confirmed"):
        part = getattr(where, name)
        if part.numel() and tuple(part.shape) != (inputs, *canvas):
            raise DamagedTensors(f"the tensor map.{name} has the shape {list(part.shape)}")


def _check_rows(name: str, index: Tensor, count: int) -> None:
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < count:
        low, high = int(index.min()), int(index.max())
        raise DamagedTensors(f"the tensor {name} names rows {low} to {high} of {count}")
