"""Smaller files of Gaussians through kept libraries: .spz (Niantic) by gsply, .sog (PlayCanvas) by gsply and sogpy.

Both are lossy: 8 bits of opacity and logarithmic scale, 8 of colour. Axes are those of the file; SPZ's are
x right, y up, z backward by its specification, those of .ply and .sog as the scene has them.
"""

import contextlib
import io
import math
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from querysplat_cli.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.ply import HIGHEST_OPACITY, export_rows, write_ply
from querysplat_cli.scene.gaussians import Gaussians

SPZ_BITS = 24
"""Of a coordinate, sign included; how many of them are fractional is chosen by the scene's size."""
MOST_FRACTIONAL_BITS = 20


def read_spz(path: Path) -> Gaussians:
    """The Gaussians of an .spz file, version 1 to 4.

    Raises MissingPart without gsply, QuerySplatError when the file is damaged.
    """
    gsply = _library("gsply")
    try:
        return _gaussians(gsply.read_spz(path))
    except (OSError, ValueError, EOFError, IndexError, MemoryError) as error:
        raise QuerySplatError(f"{path}: damaged, or no .spz: {error}", "Export it again.") from error


def write_spz(path: Path, gaussians: Gaussians) -> int:
    """Write version 3, which all readers know; returns how many Gaussians are in the file (finite ones)."""
    gsply = _library("gsply")
    rows = _finite_rows(gaussians)
    reach = float(np.abs(rows[:, :3]).max(initial=1e-30))
    bits = SPZ_BITS - 1 - max(0, math.ceil(math.log2(reach + 1e-30)))
    bands = (rows.shape[1] - 14) // 3
    data = gsply.GSData.from_arrays(
        means=rows[:, :3],
        scales=rows[:, -7:-4],
        quats=rows[:, -4:],
        opacities=rows[:, -8],
        sh0=rows[:, 3:6],
        shN=rows[:, 6:-8].reshape(-1, 3, bands).swapaxes(1, 2),
        format="ply",
    )
    with atomic_path(path) as draft:
        gsply.write_spz(draft, data, version=3, fractional_bits=min(max(bits, 1), MOST_FRACTIONAL_BITS))
    return len(rows)


def read_sog(path: Path) -> Gaussians:
    """The Gaussians of a .sog file. Raises MissingPart without gsply's part for it, QuerySplatError when damaged."""
    gsply = _library("gsply")
    try:
        return _gaussians(gsply.sogread(path))
    except ImportError as error:
        raise _missing("gsply[sogs]") from error
    except (OSError, ValueError, KeyError, IndexError, RuntimeError) as error:
        raise QuerySplatError(f"{path}: damaged, or no .sog: {error}", "Export it again.") from error


def write_sog(path: Path, gaussians: Gaussians) -> int:
    """Write a bundled .sog; returns how many Gaussians are in the file. Clustering takes seconds to minutes."""
    sogpy = _library("SogPython")
    with TemporaryDirectory() as scratch, atomic_path(path) as draft:
        plain = Path(scratch) / "scene.ply"
        written = write_ply(plain, gaussians)
        with contextlib.redirect_stdout(io.StringIO()):
            sogpy.convert_ply_to_sog(str(plain), str(draft))
    return written


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise _missing("gsply" if name == "gsply" else "sogpy") from None


def _missing(part: str) -> MissingPart:
    return MissingPart(f"this format needs {part}", "pip install 'querysplat[formats]'")


def _finite_rows(gaussians: Gaussians) -> np.ndarray:
    rows = export_rows(gaussians).numpy()
    return np.ascontiguousarray(rows[np.isfinite(rows).all(1)])


def _gaussians(data: Any) -> Gaussians:
    """From gsply's container: logits, logarithms, [n, bands, 3]."""
    colour, rest = data.sh0[:, None], data.shN
    bands = colour if rest is None or rest.size == 0 else np.concatenate([colour, rest], 1)
    parts = [data.means, data.quats, np.exp(data.scales), 1 / (1 + np.exp(-data.opacities.reshape(-1))), bands]
    means, quats, scales, opacities, sh = (torch.from_numpy(np.array(part, dtype=np.float32)) for part in parts)
    return Gaussians(means, quats, scales, opacities.clamp(1e-8, HIGHEST_OPACITY), sh)
