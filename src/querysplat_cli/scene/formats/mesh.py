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
from querysplat_cli.scene.formats.gltf import write_primitive
from querysplat_cli.scene.pictures import linear_of_srgb

MESH_KINDS = (".ply", ".glb", ".obj")
Y_UP = np.array([1, -1, -1], np.float32)
"""From the axes of a scene to those of glTF."""


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
    colours[:, :3] = np.rint(65535 * linear_of_srgb(mesh.colours / 255))
    write_primitive(path, {"POSITION": places, "COLOR_0": colours}, np.ascontiguousarray(mesh.triangles, "<u4"))
