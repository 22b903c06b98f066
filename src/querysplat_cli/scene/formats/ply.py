"""The standard 3D Gaussian splatting .ply.

One element `vertex`, float32, binary little-endian: x y z, normals (zero), f_dc_0…2, f_rest_* colour by
colour (all bands of red, of green, of blue), opacity as a logit, scale_0…2 as logarithms, rot_0…3 as
w x y z. Readers go by the properties' names.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyElement
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.gaussians import Gaussians

NORMALS = ["nx", "ny", "nz"]
LOWEST_OPACITY = 1e-8
HIGHEST_OPACITY = 1 - 6e-8
"""The largest float32 below 1: its logit, 16.6, is the largest finite one."""
SCALE_FLOOR = 1e-8
LARGEST_LOG_SCALE = 88.0
"""Its exponential is still finite in float32."""
REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3}
"""SH degree by the number of f_rest properties."""


class NoGaussian(QuerySplatError):
    """A file holds no Gaussian that can be drawn, or would hold none."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: no Gaussian with finite numbers", "Make or export the scene again.")


def finite_gaussians(path: Path, gaussians: Gaussians) -> Gaussians:
    """The Gaussians with finite numbers, of a file that is read or written. Raises NoGaussian where there is none."""
    finite = gaussians[gaussians.finite]
    if not len(finite):
        raise NoGaussian(path)
    return finite


@contextmanager
def damage_named(path: Path, what: str) -> Iterator[None]:
    """Inside, any error but a QuerySplatError becomes one that says that the file at `path` is damaged, or no `what`:
    damage can raise anything in a decoder."""
    try:
        yield
    except QuerySplatError:
        raise
    except PermissionError as error:
        raise _locked(path) from error
    except Exception as error:
        raise QuerySplatError(f"{path}: damaged, or no {what}: {error}", "Export it again.") from error


def _locked(path: Path) -> QuerySplatError:
    return QuerySplatError(f"{path}: no permission to read it", "Change its permissions, or copy it.")


def write_ply(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write `gaussians` to `path`, whole or not at all; returns how many are in the file.

    Rows with a NaN or an infinity are left out, so that number can be less than `len(gaussians)`. Raises
    QuerySplatError when no row is left, or for a name of another kind.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise QuerySplatError(f"{path}: not the name of a .ply", "`querysplat convert` makes other kinds of a .ply.")
    finite = finite_rows(path, gaussians)
    names = columns(gaussians.sh_degree)
    vertices = np.zeros(len(finite), [(name, "<f4") for name in names[:3] + NORMALS + names[3:]])
    for name, column in zip(names, finite.numpy().T, strict=True):
        vertices[name] = column
    element = PlyElement.describe(vertices, "vertex")
    with atomic_path(path) as draft:
        PlyData([element], byte_order="<", comments=list(comments)).write(str(draft))
    return len(finite)


def read_ply(path: str | Path) -> Gaussians:
    """The Gaussians in any 3DGS .ply (SH degree 0 to 3, binary or ASCII), float32.

    Saturated numbers are kept within float32: opacities above 0 and below 1, scales finite. Rows with a NaN, or with
    a number beyond float32, are left out. Raises QuerySplatError when the file is no .ply, not one of Gaussians, or
    damaged, and when no row is left.
    """
    path = Path(path)
    vertices = _vertices(path)
    present = vertices.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in present)
    missing = [name for name in columns(0) if name not in present]
    if "packed_position" in present:
        raise QuerySplatError(
            f"{path}: a compressed .ply of PlayCanvas, which is not read", "Convert it with splat-transform."
        )
    if missing == ["scale_2"]:
        raise QuerySplatError(
            f"{path}: a .ply of flat Gaussians (2DGS), which is not read: it has no scale_2",
            "Give a 3D Gaussian splatting .ply.",
        )
    if missing:
        raise QuerySplatError(
            f"{path}: a .ply, but not one of Gaussians: it has no {', '.join(missing[:4])}",
            "Meshes and point clouds cannot be rendered; give a 3D Gaussian splatting .ply.",
        )
    names = columns(REST_COUNTS.get(rest, 0))
    if rest not in REST_COUNTS or not set(names) <= set(present):
        raise QuerySplatError(f"{path}: its {rest} f_rest properties fit no SH degree from 0 to 3", "Export it again.")
    if any(vertices.dtype[name].kind not in "fiu" for name in names):
        raise QuerySplatError(f"{path}: some properties of its Gaussians are lists", "Export it again.")
    rows = torch.from_numpy(np.stack([vertices[name] for name in names], 1).astype(np.float64))
    return finite_gaussians(path, _gaussians(rows[~rows.isnan().any(1)]))


def columns(sh_degree: int) -> list[str]:
    """Property names in the order of `export_rows`."""
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    return [
        *"xyz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def export_rows(gaussians: Gaussians, opacity_threshold: float = 0.0) -> Float[Tensor, "rows columns"]:
    """The rows of the file, float32, in the order of `columns(gaussians.sh_degree)`; no normals.

    Gaussians of an opacity below the threshold are left out. Logits and logarithms are taken in float64
    of clamped values (opacity to [1e-8, 1 − 6e-8], scale + 1e-8), so that they are finite where the input
    is; quaternions are normalised, one of zero length becomes the identity.
    """
    kept = gaussians.detach().to("cpu").to(torch.float64)
    kept = kept[kept.opacities.isnan() | (kept.opacities >= opacity_threshold)]
    length = kept.quats.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    parts = [
        kept.means,
        kept.sh[:, 0],
        kept.sh[:, 1:].mT.flatten(1),
        kept.opacities.clamp(LOWEST_OPACITY, HIGHEST_OPACITY).logit()[:, None],
        (kept.scales.clamp_min(0) + SCALE_FLOOR).log(),
        torch.where(length == 0, identity, kept.quats / length),
    ]
    return torch.cat(parts, 1).float()


def finite_rows(path: Path, gaussians: Gaussians) -> Float[Tensor, "rows columns"]:
    """Those of `export_rows` that are finite, for the file at `path`. Raises NoGaussian where there is none."""
    rows = export_rows(gaussians)
    finite = rows[torch.isfinite(rows).all(1)]
    if not len(finite):
        raise NoGaussian(path)
    return finite


def _gaussians(rows: Float[Tensor, "rows columns"]) -> Gaussians:
    means, dc, rest, opacity, scale, rotation = rows.split([3, 3, rows.shape[1] - 14, 1, 3, 4], 1)
    bands = torch.cat([dc[:, None], rest.unflatten(1, (3, -1)).mT], 1) if rest.shape[1] else dc[:, None]
    return Gaussians(
        means=means,
        quats=rotation,
        scales=scale.clamp_max(LARGEST_LOG_SCALE).exp(),
        opacities=opacity[:, 0].sigmoid().clamp(LOWEST_OPACITY, HIGHEST_OPACITY),
        sh=bands,
    ).to(torch.float32)


def _vertices(path: Path) -> np.ndarray:
    if not path.is_file():
        raise QuerySplatError(f"{path}: no such file", "Give a 3D Gaussian splatting .ply.")
    try:
        try:
            data, surplus = _parsed(path.open("rb"))
        except UnicodeDecodeError:
            data, surplus = _parsed(io.BytesIO(_with_plain_header(path.read_bytes())))
        vertices = data["vertex"].data
    except PermissionError as error:
        raise _locked(path) from error
    except KeyError:
        raise QuerySplatError(f"{path}: a .ply without vertices", "Give a 3D Gaussian splatting .ply.") from None
    except Exception as error:  # damage can raise anything in the parser
        raise QuerySplatError(f"{path}: damaged, or no .ply: {error}", "Export or download it again.") from error
    if surplus:
        raise QuerySplatError(f"{path}: holds more data than its header says", "Export or download it again.")
    return vertices


def _parsed(stream: io.BufferedIOBase) -> tuple[PlyData, bool]:
    """What a stream holds, and whether more comes after that."""
    with stream:
        data = PlyData.read(stream)
        return data, not data.text and bool(stream.read(1))


def _with_plain_header(content: bytes) -> bytes:
    """The content of a .ply with a header of ASCII: comments may have been written in any other code."""
    header, end, rest = content.partition(b"end_header")
    return header.decode("ascii", "ignore").encode() + end + rest
