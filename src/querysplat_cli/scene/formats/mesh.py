"""A coloured triangle mesh, as a .ply, .glb or .obj that modelling tools read."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.optional_parts import OPTIONAL_PARTS
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.gltf import ARRAY_BUFFER, FLOAT, write_chunks

MESH_KINDS = (".ply", ".glb", ".obj")
Y_UP = np.array([1, -1, -1], np.float32)
"""From the axes of a scene to those of glTF."""
UNSIGNED_SHORT, UNSIGNED_INT, ELEMENT_ARRAY_BUFFER, TRIANGLES = 5123, 5125, 34963, 4


@dataclass(frozen=True)
class TriangleMesh:
    """Corners in the frame and the units of the scene, their colours, and for each triangle the rows of its corners.

    Seen from outside, the corners of a triangle go round anticlockwise.
    """

    places: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "m 3"]


def check_mesh_parts() -> None:
    """Raise MissingPart without the packages that make and write meshes."""
    mesh_part("trimesh")
    mesh_part("skimage")


def mesh_part(module: str) -> Any:
    """A module of a package of the extra `mesh`. Raises MissingPart without it."""
    try:
        return import_module(module)
    except ImportError:
        part = next(part for part in OPTIONAL_PARTS if part.module == module.split(".")[0])
        raise MissingPart(f"meshes need {part.package}", part.command) from None


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write the mesh, whole or not at all, in the kind that the suffix of `path` names."""
    if path.suffix.lower() == ".glb":
        _write_glb(path, mesh)
        return
    trimesh = mesh_part("trimesh")
    found = trimesh.Trimesh(mesh.places, mesh.triangles, vertex_colors=mesh.colours, process=False)
    options: Mapping[str, Any] = {"vertex_normal": False} if path.suffix.lower() == ".ply" else {}
    content = found.export(file_type=path.suffix.lower()[1:], **options)
    with atomic_path(path) as draft:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)


def _write_glb(path: Path, mesh: TriangleMesh) -> None:
    """Colours of a glTF are linear. They have 16 bits, since 8 linear ones show steps in the dark."""
    places = np.ascontiguousarray(mesh.places * Y_UP, "<f4")
    colours = np.full((len(places), 4), 65535, "<u2")
    colours[:, :3] = np.rint(65535 * _linear(mesh.colours / 255))
    columns = [places, colours, np.ascontiguousarray(mesh.triangles, "<u4")]
    kinds = [(FLOAT, "VEC3"), (UNSIGNED_SHORT, "VEC4"), (UNSIGNED_INT, "SCALAR")]
    accessors: list[dict[str, Any]] = [
        {"bufferView": view, "componentType": component, "type": kind, "count": len(places)}
        for view, (component, kind) in enumerate(kinds)
    ]
    accessors[0] |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    accessors[1] |= {"normalized": True}
    accessors[2] |= {"count": mesh.triangles.size}
    ends = np.cumsum([values.nbytes for values in columns]).tolist()
    targets = [ARRAY_BUFFER, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER]
    views = [
        {"buffer": 0, "byteOffset": end - values.nbytes, "byteLength": values.nbytes, "target": target}
        for end, values, target in zip(ends, columns, targets, strict=True)
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "mode": TRIANGLES}
    document = {
        "asset": {"version": "2.0", "generator": "querysplat"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": ends[-1]}],
    }
    write_chunks(path, document, columns)


def _linear(colours: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones, both in [0, 1]."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
