"""Results of a stage in a file, so that a later process can go on with them.

A part is a dataclass of this package, or such parts in tuples, lists and dicts. Only the classes of `CLASSES` are
created when a file is read, so a foreign file cannot run code.
"""

from pathlib import Path, PosixPath, WindowsPath
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from numpy._core.multiarray import _reconstruct

from querysplat_cli.encoders.base import Geometry, Matching, PosedViews, UsedDepthMaps
from querysplat_cli.encoders.holdout import HoldoutCameras, PoseDifference, PosedSplit
from querysplat_cli.model.anchors import Anchors, Neighbours, Reading
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.regions.scene import RegionScene, RegionTask
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import MemoryMap, PreparedQueries
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.masks import Overlay
from querysplat_cli.scene.resample import PinholeView
from querysplat_cli.scene.views import LeftOut, PhotoSource, Views

CLASSES: list[Any] = [
    *(Geometry, UsedDepthMaps, Matching, PosedViews, HoldoutCameras, PosedSplit, PoseDifference),
    *(Anchors, Neighbours, Reading, Memories, MemoryMap, PreparedQueries, Gaussians, Exposures, Cameras, PhotoCamera),
    *(Views, LeftOut, PhotoSource, PinholeView, Overlay, RegionTask, RegionScene, ReconstructSettings),
    *(PosixPath, WindowsPath, np.ndarray, np.dtype, type(np.dtype(np.float64)), _reconstruct),
]


def write_part(path: Path, part: Any) -> None:
    """Write `part`, whole or not at all. Fails as `atomic_path` does."""
    with atomic_path(path) as draft, draft.open("wb") as file:
        try:
            torch.save(part, file)
        except RuntimeError as error:  # torch's own, in which the reason is lost
            raise error.__context__ if isinstance(error.__context__, OSError) else error from None


def read_part(path: Path) -> Any:
    """What `write_part` wrote; None where there is no such file, or none that can be read."""
    if not path.is_file():
        return None
    try:
        with torch.serialization.safe_globals(CLASSES):
            return torch.load(path, weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, LookupError, AttributeError, UnpicklingError):
        return None
