"""What `convert` does for a target of levels of detail."""

import math
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.commands.compared_views import ComparedViews
from querysplat_cli.prune.merging import halved
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.files import FolderKind
from querysplat_cli.scene.formats.lod_tree import divided
from querysplat_cli.scene.formats.ply import NoGaussian
from querysplat_cli.scene.formats.streamed_index import INDEX_NAME
from querysplat_cli.scene.formats.streamed_sog import Level, read_levels, write_streamed
from querysplat_cli.scene.gaussians import Gaussians

LEVELS = FolderKind((INDEX_NAME,), ("*/meta.json", "*/*.webp"))


def write_levels(folder: Path, gaussians: Gaussians, backdrop: int, coarser: int | None) -> None:
    """Write the Gaussians as a streamed SOG with `coarser` levels beside the finest; None takes as many as it needs.

    The last Gaussians, as many as `backdrop`, become the environment. There are fewer levels where every leaf has one
    Gaussian left. Raises QuerySplatError when no Gaussian is finite.
    """
    finite = gaussians.finite
    behind = torch.arange(len(gaussians)) >= len(gaussians) - backdrop
    body, far = gaussians[finite & ~behind], gaussians[finite & behind]
    if not len(body):
        body, far = far, body
    if not len(body):
        raise NoGaussian(folder)
    division, leaf = divided(body.means.double().numpy(), PRUNE_POLICY.lod_leaf)
    levels = [Level(body, torch.from_numpy(leaf))]
    for _ in range(coarser_levels(len(body)) if coarser is None else coarser):
        found = Level(*halved(levels[-1].gaussians, levels[-1].leaf))
        if len(found.gaussians) == len(levels[-1].gaussians):
            break
        levels.append(found)
    folder.mkdir()
    write_streamed(folder, levels, division, far if len(far) else None, PRUNE_POLICY.lod_chunk)


def coarser_levels(count: int) -> int:
    """How often a scene of so many Gaussians is halved: ⌈log2(count / `PrunePolicy.lod_finest`)⌉, and once at least."""
    return max(1, math.ceil(math.log2(count / PRUNE_POLICY.lod_finest)))


def levels_entry(folder: Path, views: ComparedViews) -> dict[str, Any]:
    """What was written, as read back: the Gaussians of each level, and its PSNR (dB) on `views` of the result."""
    levels: list[dict[str, Any]] = []
    finest = 0
    for count, found in read_levels(folder):
        finest = finest or len(found)
        levels.append({"gaussians": count, "psnr": round(views.psnr(views.here(found)), 3)})
    return {"gaussians": finest, "levels": levels}
