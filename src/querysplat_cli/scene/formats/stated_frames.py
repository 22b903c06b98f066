"""The similarity that a cameras.json states, from the frame in which its scene was made to that of the file."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import FARTHEST_CENTRE
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.sim3 import Sim3


def as_entry(frame: Sim3) -> dict[str, Any]:
    """How a file states a similarity."""
    return {"scale": frame.scale, "rotation": frame.rotation.tolist(), "translation": frame.translation.tolist()}


def stated_frame(path: Path, entry: Any) -> Sim3 | None:
    """What `entry` of the file `path` states; None where it is None. Raises QuerySplatError where it makes no sense."""
    if entry is None:
        return None
    try:
        scale = float(entry["scale"])
        rigid = np.eye(4)
        rigid[:3, :3], rigid[:3, 3] = np.array(entry["rotation"], float), np.array(entry["translation"], float)
        if not (1 / FARTHEST_CENTRE <= scale <= FARTHEST_CENTRE and is_rigid(rigid)):
            raise ValueError("no similarity")
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise QuerySplatError(f"{path}: its working_frame makes no sense: {error}", "Export the file again.") from None
    return Sim3(scale, torch.from_numpy(rigid[:3, :3]), torch.from_numpy(rigid[:3, 3]))
