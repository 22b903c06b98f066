"""What a region is made of, and what becomes of it."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import PhotoSource


@dataclass(frozen=True)
class RegionTask:
    """One region before its reconstruction.

    posed: its photos and those of neighbours that overlap them, with cameras in the frame of the whole scene.
    core: how many of them are its own; they come first.
    sources: where the photos come from, by name.
    """

    posed: PosedViews
    core: int
    sources: dict[str, PhotoSource]
    settings: ReconstructSettings


@dataclass(frozen=True)
class RegionScene:
    """One region after its reconstruction, in the frame and order of its task.

    gaussians: without a backdrop.
    depth: what its core photos see, at the size of `owners.small_cameras`; infinite where they see nothing.
    memories, anchors, map, kept: as in `StoredScene`.
    exposures: the colour transforms of its photos; None where they agree.
    disagreement: how far its photos differ in colour; None where that was not measured.
    size: the longer side of the pictures that it was optimised on last, in pixels.
    entries: for the report: `quality`, `seconds`, `peak_memory_gib`, `tto`, `full_size`, `left_out`, `warnings`.
    """

    gaussians: Gaussians
    depth: Float[Tensor, "core height width"]
    memories: Memories
    anchors: Anchors | None
    map: MemoryMap
    kept: Bool[Tensor, "n"] | None
    exposures: Exposures | None
    disagreement: float | None
    size: int
    entries: dict[str, Any]
