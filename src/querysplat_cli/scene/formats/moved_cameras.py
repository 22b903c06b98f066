"""A file of cameras in another frame."""

from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.scene.files import write_json
from querysplat_cli.scene.formats.transforms import as_entry, read_cameras, working_frame
from querysplat_cli.scene.sim3 import Sim3


def move_cameras(source: Path, target: Path, place: Sim3) -> None:
    """Write the cameras of a cameras.json in the frame that `place` maps to; all else stays, `working_frame` as well.

    Raises QuerySplatError as `read_cameras` does.
    """
    read_cameras(source)
    content = read_json(source)
    frame = place.after(working_frame(source) or Sim3.identity())
    for key in ("frames", "heldout_frames"):
        if content.get(key):
            content[key] = [_moved(entry, place) for entry in content[key]]
    write_json(target, {**content, "working_frame": as_entry(frame)})


def _moved(entry: dict[str, Any], place: Sim3) -> dict[str, Any]:
    c2w = np.array(entry["transform_matrix"], dtype=np.float64)
    rotation = place.rotation.numpy()
    c2w[:3, 3] = place.scale * rotation @ c2w[:3, 3] + place.translation.numpy()
    c2w[:3, :3] = rotation @ c2w[:3, :3]
    return {**entry, "transform_matrix": c2w.tolist()}
