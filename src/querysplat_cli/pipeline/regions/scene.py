"""What a region is made of, and what becomes of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import PreparedQueries
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
    transients: pixels that show them, by the row of a photo that shows some.
    depth: what its core photos see, as `owners.depth_maps` has it.
    prepared: its queries, without any row: the last optimisation undoes what they decode to. What is left is
        the shape of their tensors, which the files of a scene have.
    exposures: the colour transforms of its photos; None where they agree.
    disagreement: how far its photos differ in colour; None where that was not measured.
    size: the longer side of the pictures that it was optimised on last, in pixels.
    entries: for the report: `quality`, `seconds`, `peak_memory_gib`, `tto`, `full_size`, `left_out`, `warnings`; and
        `depth_maps`, which is a UsedDepthMaps or None.
    """

    gaussians: Gaussians
    transients: dict[int, Bool[Tensor, "_ _"]]
    depth: Float[Tensor, "core height width"]
    prepared: PreparedQueries
    exposures: Exposures | None
    disagreement: float | None
    size: int
    entries: dict[str, Any]


@dataclass(frozen=True)
class KeptRegions:
    """Regions by number, from 0, which are read from their files when they are asked for."""

    read: Callable[[int], RegionScene]

    def __getitem__(self, number: int) -> RegionScene:
        return self.read(number)

    def without_gaussians(self, number: int) -> RegionScene:
        """A region and none of its Gaussians."""
        found = self.read(number)
        return replace(found, gaussians=found.gaussians[torch.zeros(0, dtype=torch.long)])
