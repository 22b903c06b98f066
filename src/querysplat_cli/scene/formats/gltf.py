"""glTF 2.0 with KHR_gaussian_splatting (release candidate of July 2026), as one binary .glb file.

A scene is a primitive of points. Rotations are x, y, z, w; scales are linear, opacities in [0, 1]; SH have the order
and sign of 3DGS. Axes are those of the file: +y is up.
"""

import itertools
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.gltf_nodes import placement
from querysplat_cli.scene.formats.ply import (
    HIGHEST_OPACITY,
    LARGEST_LOG_SCALE,
    LOWEST_OPACITY,
    damage_named,
    finite_gaussians,
)
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.sim3 import Sim3

EXTENSION = "KHR_gaussian_splatting"
COLOUR_SPACE = "srgb_rec709_display"
"""That of 3DGS. Linear colours are blended otherwise, so that no coefficients give the same pictures."""
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, POINTS, TRIANGLES = 5126, 34962, 34963, 0, 4
COMPONENTS = {"<f4": FLOAT, "<u2": 5123, "<u4": 5125}
STORED = {5120: ("i1", 127), 5121: ("u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535), FLOAT: ("<f4", 1)}
"""How numbers may be stored, and what stands for 1 where integers are normalised."""
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
HEADER = struct.Struct("<III")
CHUNK = struct.Struct("<II")


def write_glb(path: Path, gaussians: Gaussians) -> int:
    """Write the finite Gaussians; returns how many there are."""
    finite = finite_gaussians(path, gaussians)
    attributes = {name: np.ascontiguousarray(values, "<f4") for name, values in _attributes(finite).items()}
    write_primitive(path, attributes, extensions={EXTENSION: {"kernel": "ellipse", "colorSpace": COLOUR_SPACE}})
    return len(finite)


def write_primitive(
    path: Path, attributes: Mapping[str, np.ndarray], triangles: np.ndarray | None = None, **properties: Any
) -> None:
    """Write a .glb of one primitive of points, or of `triangles` [m, 3] (uint32), with further `properties`.

    Attributes [n, k] are float32, or uint16 for shares of 65,535. POSITION is the first. A row takes a multiple of 4
    bytes.
    """
    columns = list(attributes.values())
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "mode": POINTS if triangles is None else TRIANGLES,
        **properties,
    }
    if triangles is not None:
        primitive["indices"] = len(columns)
        columns.append(triangles.reshape(-1, 1))
    listing = json.dumps(_document(columns, primitive), separators=(",", ":")).encode()
    listing += b" " * (-len(listing) % 4)
    size = sum(values.nbytes for values in columns)
    total = HEADER.size + CHUNK.size + len(listing) + CHUNK.size + size
    with atomic_path(path) as draft, draft.open("wb") as file:
        file.write(HEADER.pack(MAGIC, 2, total) + CHUNK.pack(len(listing), JSON_CHUNK) + listing)
        file.write(CHUNK.pack(size, BINARY_CHUNK))
        for values in columns:
            file.write(values.tobytes())


def read_glb(path: Path) -> list[tuple[Gaussians, Sim3 | None]]:
    """The Gaussians of each mesh of a .glb that has some, and from the mesh's frame to that of the file.

    The latter is None where the two are one. Raises QuerySplatError when the file is damaged or compressed, or a node
    of it stretches, mirrors or flattens Gaussians.
    """
    found = []
    with damage_named(path, ".glb of Gaussians"):
        document, binary = _chunks(path.read_bytes())
        for mesh, primitives in _meshes_of_gaussians(path, document).items():
            parts = [_gaussians(path, document, each["attributes"], binary) for each in primitives]
            found.append((joined(*parts), placement(document, mesh)))
    return [(finite_gaussians(path, gaussians), place) for gaussians, place in found]


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1)
    found = {
        "POSITION": gaussians.means.numpy(),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]].numpy(),
        f"{EXTENSION}:SCALE": gaussians.scales.numpy(),
        f"{EXTENSION}:OPACITY": gaussians.opacities.numpy()[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        for number in range(2 * degree + 1):
            found[_coefficient(degree, number)] = gaussians.sh[:, degree**2 + number].numpy()
    return found


def _coefficient(degree: int, number: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}"


def _document(columns: Sequence[np.ndarray], primitive: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON of a .glb whose buffer holds the columns of its primitive, one after another."""
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": number,
            "componentType": COMPONENTS[values.dtype.str],
            "count": len(values),
            "type": KINDS[values.shape[1]],
            **({"normalized": True} if values.dtype == np.uint16 else {}),
        }
        for number, values in enumerate(columns)
    ]
    accessors[0] |= {"min": columns[0].min(0).tolist(), "max": columns[0].max(0).tolist()}
    offsets = np.concatenate([[0], np.cumsum([values.nbytes for values in columns])]).tolist()
    views = [
        {
            "buffer": 0,
            "byteOffset": start,
            "byteLength": end - start,
            "target": ELEMENT_ARRAY_BUFFER if number == primitive.get("indices") else ARRAY_BUFFER,
        }
        for number, (start, end) in enumerate(itertools.pairwise(offsets))
    ]
    extensions = primitive.get("extensions")
    return {
        "asset": {"version": "2.0", "generator": "querysplat"},
        **({"extensionsUsed": list(extensions)} if extensions else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1]}],
    }


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = HEADER.unpack_from(content)
    if magic != MAGIC or version != 2 or total > len(content):
        raise ValueError("its header is not that of a whole glTF 2.0 file")
    length, kind = CHUNK.unpack_from(content, HEADER.size)
    start = HEADER.size + CHUNK.size
    if kind != JSON_CHUNK:
        raise ValueError("it does not begin with its JSON")
    document = json.loads(content[start : start + length])
    size, kind = CHUNK.unpack_from(content, start + length)
    if kind != BINARY_CHUNK:
        raise ValueError("it has no binary part")
    begin = start + length + CHUNK.size
    return document, content[begin : begin + size]


def _refuse_compressed(path: Path, part: Mapping[str, Any], what: str) -> None:
    if part.get("extensions"):
        names = ", ".join(part["extensions"])
        why = f"{path}: {what} compressed with {names}, which is not read"
        raise QuerySplatError(why, "Export it without compression, or as a .ply.")


def _meshes_of_gaussians(path: Path, document: dict[str, Any]) -> dict[int, list[dict[str, Any]]]:
    """Of each mesh with Gaussians, by its number, the primitives that are Gaussians."""
    found = {}
    for number, mesh in enumerate(document["meshes"]):
        primitives = [each for each in mesh["primitives"] if EXTENSION in each.get("extensions", {})]
        if primitives:
            found[number] = primitives
    if not found:
        raise ValueError(f"nothing in it has {EXTENSION}; a mesh is no scene of Gaussians")
    for extension in (each["extensions"][EXTENSION] for primitives in found.values() for each in primitives):
        space = extension.get("colorSpace", COLOUR_SPACE)
        if space != COLOUR_SPACE:
            raise ValueError(f"its colours are those of {space}, and only {COLOUR_SPACE} is read")
        _refuse_compressed(path, extension, "its Gaussians are")
    return found


def _gaussians(path: Path, document: dict[str, Any], attributes: dict[str, int], binary: bytes) -> Gaussians:
    def column(name: str) -> torch.Tensor:
        accessor = document["accessors"][attributes[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        _refuse_compressed(path, view, f"its {name} is")
        kind, one = STORED[accessor["componentType"]]
        size = np.dtype(kind).itemsize
        width = next(count for count, shape in KINDS.items() if shape == accessor["type"])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        row = view.get("byteStride", size * width)
        values = np.ndarray((accessor["count"], width), kind, binary, start, (row, size)).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / one, -1)
        return torch.from_numpy(values.astype(np.float32))

    degree = 0
    while _coefficient(degree + 1, 0) in attributes:
        degree += 1
    bands = [column(_coefficient(each, number)) for each in range(degree + 1) for number in range(2 * each + 1)]
    scales = column(f"{EXTENSION}:SCALE")
    if (scales < 0).any():  # no linear scale is; drafts of the specification had logarithms
        scales = scales.clamp_max(LARGEST_LOG_SCALE).exp()
    return Gaussians(
        column("POSITION"),
        column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
        scales,
        column(f"{EXTENSION}:OPACITY")[:, 0].clamp(LOWEST_OPACITY, HIGHEST_OPACITY),
        torch.stack(bands, 1),
    )
