"""The 3DGS .ply that viewers take: logits, logs and channel-major SH on disk, plain numbers in memory."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from querysplat_cli.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.gaussians import Gaussians

OPACITY_LIMIT = 1e-8
"""Opacities are kept this far from 0 and 1, in float64: in float32, 1 − 1e-8 is 1 and its logit infinite."""
REST_COUNTS = {0: 1, 9: 4, 24: 9, 45: 16}
"""Number of f_rest properties → SH bands."""


def write_ply(path: Path, gaussians: Gaussians) -> int:
    """Write binary little-endian float32 with zero normals; returns the number of rows.

    Rows that hold NaN or Inf are left out. The file appears whole or not at all.
    """
    columns = _columns(gaussians, normals=True)
    table = np.stack(list(columns.values()), 1).astype("<f4")
    table = table[np.isfinite(table).all(1)]
    rows = np.ascontiguousarray(table).view([(name, "<f4") for name in columns])[:, 0]
    with atomic_path(path) as draft:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(draft))
    return len(rows)


def export_rows(gaussians: Gaussians, opacity_threshold: float) -> tuple[list[str], Float[Tensor, "rows columns"]]:
    """Column names and rows as the authors' release exports them: no normals, opaque enough rows only."""
    columns = _columns(gaussians[gaussians.opacities >= opacity_threshold], normals=False)
    return list(columns), torch.from_numpy(np.stack(list(columns.values()), 1).astype(np.float32))


def read_ply(path: Path) -> Gaussians:
    """Gaussians from any 3DGS .ply of SH degree 0 to 3, whatever the order of its properties.

    Raises QuerySplatError when the file is missing, damaged, or no Gaussian splatting scene.
    """
    if not path.is_file():
        raise QuerySplatError(f"{path}: no such file", "Give a .ply that holds 3D Gaussians.")
    try:
        vertices = PlyData.read(str(path))["vertex"].data
    except (PlyParseError, KeyError, ValueError, EOFError, OSError) as error:
        raise QuerySplatError(f"{path} is not a readable .ply: {error}", "It may be cut off; make it again.") from error
    names = set(vertices.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in names)
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    needed += ["rot_0", "rot_1", "rot_2", "rot_3", *(f"f_rest_{i}" for i in range(rest))]
    missing = [name for name in needed if name not in names]
    if missing or rest not in REST_COUNTS:
        what = f"it has no {', '.join(missing[:4])}" if missing else f"{rest} f_rest properties fit no SH degree"
        raise QuerySplatError(
            f"{path} is a .ply, but not of 3D Gaussians: {what}", "A mesh or a point cloud cannot be used."
        )

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([vertices[name].astype(np.float64) for name in wanted], 1)

    bands = REST_COUNTS[rest]
    first = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    parts = [first]
    if rest:
        by_colour = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(-1, 3, bands - 1)
        parts.append(by_colour.transpose(0, 2, 1))
    arrays = (
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        1 / (1 + np.exp(-columns("opacity")[:, 0])),
        np.concatenate(parts, 1),
    )
    return Gaussians(*(torch.from_numpy(array.astype(np.float32)) for array in arrays))


def _columns(gaussians: Gaussians, *, normals: bool) -> dict[str, np.ndarray]:
    """Every property of the file by name, in its order, in float64."""
    means, quats, scales, opacities, sh = (
        part.detach().double().cpu().numpy()
        for part in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    )
    opacity = np.clip(opacities, OPACITY_LIMIT, 1 - OPACITY_LIMIT)
    length = np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)
    zero = np.zeros(len(means))
    named = {axis: means[:, i] for i, axis in enumerate("xyz")}
    if normals:
        named |= dict.fromkeys(("nx", "ny", "nz"), zero)
    groups = [("f_dc", sh[:, 0]), ("f_rest", rest), ("opacity", np.log(opacity / (1 - opacity))[:, None])]
    groups += [("scale", np.log(scales + 1e-8)), ("rot", quats / length)]
    for name, values in groups:
        several = name != "opacity"
        named |= {f"{name}_{i}" if several else name: values[:, i] for i in range(values.shape[1])}
    return named
