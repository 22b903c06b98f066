"""A run's folder: one folder for each case of each split of each row, as the release lays out its own.

out/
  splits/                        the splits, in the release's form and as index files
  summary.json .md .csv
  <row>/<split>/
    run_config.json              what was run, on which split, with which checkpoint
    <case>/metrics.json          scores by view, and the frames
    <case>/timing.json           seconds by stage, peak memory, Gaussians
    <case>/cameras.npz           the cameras of the scored pictures
    <case>/failure.json          instead of these, where no scene could be made
    <case>/rendered/, <case>/nerfbaselines/   pictures that were asked for
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.evaluation.judge import RowResult, ViewScore
from querysplat_cli.evaluation.metrics import ALL_METRICS
from querysplat_cli.evaluation.splits import GROUPS, Split
from querysplat_cli.model.checkpoints import weights_file
from querysplat_cli.reporting.report import machine
from querysplat_cli.runtime import json_files
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_folder, write_json
from querysplat_cli.splat.conventions import MID_GREY, RELEASE

REMOVE = "Remove its folder and run the command again."
NOT_COMPARED = ("machine", "torch", "querysplat")
"""Entries that may differ between shards of one run."""


@dataclass(frozen=True)
class RowFolder:
    """The folder of one row's results on one split."""

    out: Path
    row: str
    split: str

    @property
    def path(self) -> Path:
        return self.out / self.row / self.split

    def case(self, name: str) -> Path:
        return self.path / name

    def is_done(self, name: str) -> bool:
        return (self.case(name) / "metrics.json").is_file()

    def done(self) -> list[str]:
        """The names of the cases that have scores."""
        return [case.name for case in self.path.iterdir() if self.is_done(case.name)]


def open_row_folder(row_folder: RowFolder, config: dict[str, Any], *, force: bool) -> None:
    """Write `config` into a new folder, or check that an existing folder has the same.

    Raises QuerySplatError when the folder has results of other settings; `force` removes these instead.
    """
    file = row_folder.path / "run_config.json"
    if file.is_file() and force:
        shutil.rmtree(row_folder.path)
    if file.is_file():
        check_same_settings(row_folder.path, read_json(file), config)
        return
    write_json(file, config)


def check_same_settings(path: Path, before: dict[str, Any], config: dict[str, Any]) -> None:
    """Raise QuerySplatError when the results in `path` are of `before`, and those are not the settings of `config`."""
    keys = [key for key in before | config if key not in NOT_COMPARED]
    changed = [key for key in keys if config.get(key) != before.get(key)]
    if changed:
        raise QuerySplatError(
            f"{path} was made with other settings ({', '.join(changed)})",
            "Choose another output, or add --force to begin again.",
        )


def run_config(settings: dict[str, Any], split: Split, protocol: str, lpips: dict[str, str]) -> dict[str, Any]:
    """The content of run_config.json. `settings` are those of the row."""
    content = json.dumps(
        [[case.name, *[[vars(ref) for ref in case.groups[g]] for g in GROUPS]] for case in split.cases]
    )
    return {
        "settings": settings,
        "protocol": protocol,
        "split": {
            "name": split.name,
            "num_input_views": split.views,
            "scale": split.scale,
            "total_samples": len(split.cases),
            "sha256": hashlib.sha256(content.encode()).hexdigest(),
        },
        "lpips": lpips,
        "rendering": {"background": MID_GREY, "alpha_max": RELEASE.alpha_max},
        "torch": torch.__version__,
        "querysplat": version("querysplat"),
        "machine": machine(),
    }


@lru_cache
def checkpoint_sha256(preset: str, weights: Path | None) -> str:
    """SHA-256 of the weights that `load` reads."""
    with weights_file(preset, weights) as file, file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_case(
    folder: Path, scene: str, result: RowResult, write_pictures: Callable[[Path, RowResult], None] | None = None
) -> None:
    """Write one case's scores, times and cameras, and what `write_pictures` adds to the folder."""
    with atomic_folder(folder) as draft:
        metrics = {
            "scene_id": scene,
            "frames": {
                group: [{"name": view.frame.name, "frame_index": view.frame.index} for view in views]
                for group, views in result.views.items()
            },
            "per_view": {group: [vars(view.scores) for view in views] for group, views in result.views.items()},
            "mean": {group: _mean(views) for group, views in result.views.items()},
            "missing": result.missing,
            "apart": result.apart,
            "doubts": list(result.warnings),
        }
        write_json(draft / "metrics.json", metrics)
        write_json(draft / "timing.json", _timing(result))
        _write_cameras(draft / "cameras.npz", result)
        if write_pictures:
            write_pictures(draft, result)


def write_failure(
    folder: Path,
    scene: str,
    message: str,
    hint: str = "",
    *,
    asked: Mapping[str, int] | None = None,
    apart: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write why a case has no scores. By group, `asked` are the numbers of its views, `apart` those of `Judge`."""
    with atomic_folder(folder) as draft:
        content = {"scene_id": scene, "error": message, "hint": hint, "asked": asked or {}, "apart": apart or {}}
        write_json(draft / "failure.json", content)


def row_folders(out: Path) -> list[RowFolder]:
    """The folders of all rows and splits with results in `out`."""
    found = sorted(out.glob("*/*/run_config.json"))
    return [RowFolder(out, file.parent.parent.name, file.parent.name) for file in found]


def has_results(out: Path) -> bool:
    """Whether a case is done in `out`."""
    return any(row_folder.done() for row_folder in row_folders(out))


def read_json(path: Path) -> Any:
    """Raises QuerySplatError when the file cannot be read."""
    return json_files.read_json(path, REMOVE)


def _mean(views: Sequence[ViewScore]) -> dict[str, float | None]:
    return {metric: mean(getattr(view.scores, metric) for view in views) for metric in ALL_METRICS}


def mean(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are not None; None where all are."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None


def _timing(result: RowResult) -> dict[str, Any]:
    seconds = {stage: round(cost.seconds, 3) for stage, cost in result.costs.items()}
    return {
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "peak_memory_gib": max((round(cost.peak_gib, 3) for cost in result.costs.values()), default=None),
        "gaussians": result.gaussians,
        "machine": machine(),
    }


def _write_cameras(path: Path, result: RowResult) -> None:
    views = [(group, view) for group, views in result.views.items() for view in views if view.camera]
    cameras = [view.camera for _, view in views if view.camera]
    np.savez(
        path,
        names=np.array([view.frame.name for _, view in views]),
        groups=np.array([group for group, _ in views]),
        w2c=np.array([camera.w2c for camera in cameras]).reshape(-1, 4, 4),
        focal=np.array([camera.focal for camera in cameras]).reshape(-1, 2),
        principal=np.array([camera.principal for camera in cameras]).reshape(-1, 2),
        distortion=np.array([camera.distortion for camera in cameras]).reshape(-1, 4),
        size=np.array([(camera.height, camera.width) for camera in cameras]).reshape(-1, 2),
    )
