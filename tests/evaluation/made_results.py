"""Results of made-up scores."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.evaluation.costs import Cost
from querysplat_cli.evaluation.judge import RowResult, ViewScore
from querysplat_cli.evaluation.metrics import Scores
from querysplat_cli.evaluation.results import RowFolder, open_row_folder, run_config
from querysplat_cli.evaluation.splits import Case, FrameRef, Split
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.dataset import Frame


def split(name: str, scale: str, cases: int = 2) -> Split:
    refs = {group: (FrameRef("", 0),) for group in ("input", "interp", "extrap")}
    return Split(name, "d", 4, scale, tuple(Case(f"s_{i:03d}", "s", refs) for i in range(cases)))


def view(number: int, psnr: float, ssim: float = 0.5) -> ViewScore:
    camera = PhotoCamera(np.eye(4), (1.0, 1.0), (0.5, 0.5), (0.0, 0.0, 0.0, 0.0), 4, 4)
    frame = Frame(number, f"{number}.png", "", Path(f"{number}.png"))
    return ViewScore(frame, camera, Scores(psnr, ssim, None), torch.zeros(3, 4, 4))


def result(*interp: float, seconds: float = 2.0, gaussians: int = 10) -> RowResult:
    views = {
        "input": [view(0, 30.0)],
        "interp": [view(i + 1, float(psnr)) for i, psnr in enumerate(interp)],
        "extrap": [],
    }
    missing = {"input": {}, "interp": {}, "extrap": {"9.png": "it has no camera"}}
    apart: dict[str, list[str]] = {"input": [], "interp": [], "extrap": []}
    return RowResult(views, missing, apart, {"cameras": Cost(1.0, 0.5), "tto": Cost(seconds, 0.75)}, gaussians, ())


def settings(**changes: Any) -> dict[str, Any]:
    return {"tto": 0, **changes}


def start(out: Path, row: str, on: Split, **changes: Any) -> RowFolder:
    row_folder = RowFolder(out, row, on.name)
    open_row_folder(row_folder, run_config(settings(**changes), on, "release", {"missing": "no LPIPS"}), force=False)
    return row_folder
