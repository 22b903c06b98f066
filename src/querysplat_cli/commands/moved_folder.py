"""The folder of a scene goes with its Gaussians when these are turned, scaled or cut."""

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from safetensors.torch import save
from torch import Tensor

from querysplat_cli.pipeline.gaussian_files import folder_of_scene
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.pipeline.scene_folder import StoredScene, scores_of
from querysplat_cli.reporting.omissions import PRECISION, Omission
from querysplat_cli.reporting.preview import write_preview
from querysplat_cli.reporting.report import rescored
from querysplat_cli.reporting.unseen import unseen
from querysplat_cli.runtime.checkpoint_files import read_tensors
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.moved_cameras import move_cameras
from querysplat_cli.scene.formats.supersplat import write_supersplat
from querysplat_cli.scene.formats.transforms import read_working_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3

FILES = ("photos.json", "points.safetensors", "exposures.json")
"""Files of a scene folder that do not depend on the frame of its files, nor on which Gaussians there are."""


@dataclass(frozen=True)
class Moved:
    """What became of the Gaussians of a scene.

    target: their new file. place: the way from the frame of the old files to that of the new ones.
    kept: which of the Gaussians are there. gaussians: these, as the new file has them, in the frame of the scene.
    size: bytes of the new file. left_out: what is not in it.
    """

    target: Path
    place: Sim3
    kept: Bool[Tensor, "n"]
    gaussians: Gaussians
    size: int
    left_out: list[Omission]


def write_moved_folder(source: Path, draft: Path, moved: Moved) -> list[str]:
    """Write the scene folder `source` to `draft`, for the Gaussians that `moved` keeps, in their new frame.

    Without memories that fit the Gaussians, the new folder has none, and suits every verb but `tto` and `inspect`.
    Returns a warning where that is because `source` is damaged.
    """
    draft.mkdir()
    move_cameras(source / "cameras.json", draft / "cameras.json", moved.place)
    inputs, _, frame = read_working_cameras(draft / "cameras.json")
    write_supersplat(draft / "supersplat.json", moved.gaussians, inputs.cameras, inputs.sizes, frame)
    if (source / "images").is_dir():
        shutil.copytree(source / "images", draft / "images", copy_function=shutil.copyfile)
    for name in FILES:
        if (source / name).is_file():
            shutil.copyfile(source / name, draft / name)
    try:
        scene, report = read_scene(source)
    except QuerySplatError as error:
        parts = ("report.json", "memories.safetensors")
        lost = any((source / name).exists() for name in parts)  # cameras and photos alone are no damage
        return [f"the new folder has no report and no memories: {error.message}"] if lost else []
    tensors = None if report["gaussians"] != len(moved.kept) else _fitting_memories(source, report, moved.kept)
    if tensors is None:
        return []
    (draft / "memories.safetensors").write_bytes(tensors)
    (draft / "report.json").write_text(json.dumps(_brought_up_to_date(report, scene, moved), indent=2) + "\n")
    write_preview(draft / "preview.png", moved.gaussians, scene.groups)
    if (source / "curve.png").is_file():
        shutil.copyfile(source / "curve.png", draft / "curve.png")
    return []


def _fitting_memories(source: Path, report: dict[str, Any], kept: Bool[Tensor, "n"]) -> bytes | None:
    """The memories' file for the Gaussians that are `kept`; None where it was that of other Gaussians."""
    body = len(kept) - report.get("backdrop", 0)
    tensors, metadata = read_tensors(source / "memories.safetensors")
    if not any(run["space"] == "gaussians" and run["steps"] for run in report["tto"]):
        # The memories decode to the Gaussians, so they have to know which of these are there.
        decoded = tensors.get("kept", torch.ones(body, dtype=torch.bool)).clone()
        if int(decoded.sum()) != body:
            return None
        decoded[decoded.clone()] = kept[:body]
        tensors = {**tensors, "kept": decoded}
    return save(tensors, metadata=metadata)


def _brought_up_to_date(report: dict[str, Any], scene: StoredScene, moved: Moved) -> dict[str, Any]:
    """The report with what is true of the Gaussians that `moved` has. What the making took stays."""
    hidden = unseen(moved.gaussians, scene.cameras, scene.views.sizes)
    backdrop = report.get("backdrop", 0)
    before = [entry for entry in report["left_out"] if entry["what"] != PRECISION]  # that of the old file
    return {
        **report,
        "ply": str(moved.target),
        "scene": str(folder_of_scene(moved.target)),
        "gaussians": int(moved.kept.sum()),
        "backdrop": int(moved.kept[len(moved.kept) - backdrop :].sum()),
        "quality": rescored(scores_of(scene, moved.gaussians), report["quality"]),
        "unseen": hidden.entry() if hidden else None,
        "scale": report.get("scale") if moved.place.scale == 1 else None,
        "bytes": moved.size,
        "left_out": [*before, *map(asdict, moved.left_out)],
    }
