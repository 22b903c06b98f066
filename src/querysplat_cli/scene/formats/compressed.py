"""Niantic's .spz through gsply.

It is lossy: 8 bits of opacity, logarithmic scale and colour; SH beyond the first are clamped to [−1, 1). Axes are those
of the file: x right, y up, z backward by its specification.
"""

import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.ply import HIGHEST_OPACITY, damage_named, finite_gaussians, finite_rows
from querysplat_cli.scene.gaussians import Gaussians

SPZ_BITS = 24
"""Bits of a coordinate, sign included. The scene's size determines how many of them are fractional."""
MOST_FRACTIONAL_BITS = 20
FARTHEST_COORDINATE = 2 ** (SPZ_BITS - 2)
"""In units of the scene. At least one bit is fractional, as readers expect."""


def read_spz(path: Path) -> Gaussians:
    """The Gaussians of an .spz file, version 1 to 4.

    Raises MissingPart without gsply, QuerySplatError when the file is damaged.
    """
    gsply = _gsply()
    with damage_named(path, ".spz"):
        gaussians = _gaussians(gsply.read_spz(path))
    return finite_gaussians(path, gaussians)


def write_spz(path: Path, gaussians: Gaussians, version: int = 3) -> int:
    """Write version 3 (gzip), which all readers support, or 4 (Zstandard); returns how many Gaussians are in the file.

    These are the finite ones. What lies beyond ±`FARTHEST_COORDINATE` on an axis is moved to there.
    """
    gsply = _gsply()
    rows = finite_rows(path, gaussians).numpy()
    reach = float(np.abs(rows[:, :3]).max(initial=1e-30))
    bits = SPZ_BITS - 1 - max(0, math.ceil(math.log2(reach + 1e-30)))
    bands = (rows.shape[1] - 14) // 3
    data = gsply.GSData.from_arrays(
        means=rows[:, :3],
        scales=rows[:, -7:-4],
        quats=rows[:, -4:],
        opacities=rows[:, -8],
        sh0=rows[:, 3:6],
        shN=rows[:, 6:-8].reshape(len(rows), 3, bands).swapaxes(1, 2),
        format="ply",
    )
    with atomic_path(path) as draft:
        gsply.write_spz(draft, data, version=version, fractional_bits=min(max(bits, 1), MOST_FRACTIONAL_BITS))
    return len(rows)


def moved_to_border(path: Path, gaussians: Gaussians) -> int:
    """How many of the Gaussians, in the units of the file, `write_spz` moves; 0 where `path` is no .spz."""
    if path.suffix.lower() != ".spz":
        return 0
    reach = gaussians.means.abs().amax(1)
    return int(((reach > FARTHEST_COORDINATE) & reach.isfinite()).sum())


def check_spz() -> None:
    """Raise MissingPart without what writes .spz."""
    _gsply()


def _gsply() -> Any:
    try:
        return import_module("gsply")
    except ImportError:
        raise MissingPart("this format needs gsply", install_command("formats")) from None


def _gaussians(data: Any) -> Gaussians:
    """From gsply's container: logits, logarithms, [n, bands, 3]."""
    colour, rest = data.sh0[:, None], data.shN
    bands = colour if rest is None or rest.size == 0 else np.concatenate([colour, rest], 1)
    parts = [data.means, data.quats, np.exp(data.scales), 1 / (1 + np.exp(-data.opacities.reshape(-1))), bands]
    means, quats, scales, opacities, sh = (torch.from_numpy(np.array(part, dtype=np.float32)) for part in parts)
    return Gaussians(means, quats, scales, opacities.clamp(1e-8, HIGHEST_OPACITY), sh)
