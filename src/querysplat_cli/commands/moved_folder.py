"""The folder of a scene goes with its Gaussians when these are turned, scaled or cut."""

import json
import shutil
from pathlib import Path

import torch
from jaxtyping import Bool
from safetensors.torch import save
from torch import Tensor

from querysplat_cli.reporting.stored_report import report_of
from querysplat_cli.runtime.checkpoint_files import read_tensors
from querysplat_cli.scene.formats.moved_cameras import move_cameras
from querysplat_cli.scene.sim3 import Sim3

FILES = ("photos.json", "points.safetensors", "exposures.json", "preview.png", "curve.png")
"""Files of a scene folder that do not depend on the frame of its files, nor on which Gaussians there are."""


def write_moved_folder(source: Path, draft: Path, place: Sim3, kept: Bool[Tensor, "n"]) -> None:
    """Write the scene folder `source` to `draft`, for its Gaussians that are `kept`, in the frame that `place` maps to.

    Without memories that fit the Gaussians, the new folder has none, and suits every verb but `tto` and `inspect`.
    """
    draft.mkdir()
    move_cameras(source / "cameras.json", draft / "cameras.json", place)
    if (source / "images").is_dir():
        shutil.copytree(source / "images", draft / "images")
    for name in FILES:
        if (source / name).is_file():
            shutil.copy(source / name, draft / name)
    report = report_of(source, len(kept))
    if report is None or not (source / "memories.safetensors").is_file():
        return
    body = len(kept) - report.get("backdrop", 0)
    tensors, metadata = read_tensors(source / "memories.safetensors")
    if not any(run["space"] == "gaussians" and run["steps"] for run in report["tto"]):
        # The memories decode to the Gaussians, so they have to know which of these are there.
        decoded = tensors.get("kept", torch.ones(body, dtype=torch.bool)).clone()
        if int(decoded.sum()) != body:
            return
        decoded[decoded.clone()] = kept[:body]
        tensors = {**tensors, "kept": decoded}
    report |= {"gaussians": int(kept.sum()), "backdrop": int(kept[body:].sum())}
    (draft / "memories.safetensors").write_bytes(save(tensors, metadata=metadata))
    (draft / "report.json").write_text(json.dumps(report, indent=2) + "\n")
