"""The report of a run: the object that `--json` prints and `report.json` keeps."""

import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from querysplat_cli.encoders.base import Matching
from querysplat_cli.encoders.holdout import PoseDifference
from querysplat_cli.reporting.view_scores import Quality
from querysplat_cli.runtime.choices import HoldoutProtocol
from querysplat_cli.runtime.matching_weights import INSTALL
from querysplat_cli.runtime.threads import cores
from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.cameras import Cameras, distances, project_points
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import rotation_angles
from querysplat_cli.scene.views import LeftOut
from querysplat_cli.tto.exposure_fit import PhotoColours
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.plan import TtoRun


@dataclass(frozen=True)
class Report:
    """One run. The fields are the JSON object's, described in docs/cli.md.

    `left_out` lists what was left out of the scene or of the work; each entry is an `Omission`. `warnings` are
    sentences on why the scene may be wrong. `full_size` describes the optimisation on large photos, if there was
    one. `exposure` says how far the photos agree in colour, where that was measured. `backdrop` counts the Gaussians of
    the backdrop, the last ones of the file. `scale` says where metres come from (None: lengths are in no unit).
    `unseen` is how much of a film around the scene no photo saw (None where there is no film). `matching` says what a
    network did, or would have done, for photos that SIFT matches badly. `depth_maps` counts those that came with the
    photos and those that are used, and says how far these are off (None: none came). `bytes` is the size of the file
    `ply` (None: in reports of earlier versions). `regions` has one entry for each region, and `seams` for every two
    that overlap (both empty where there is one region). `resumed` says what came from an unfinished run.
    """

    ply: str
    scene: str
    views: dict[str, Any]
    gaussians: int
    seconds: dict[str, float]
    quality: dict[str, Any]
    left_out: list[dict[str, Any]]
    warnings: list[str]
    tto: list[dict[str, Any]]
    settings: dict[str, Any]
    peak_memory_gib: float
    machine: str
    memory_estimate_gib: float | None = None
    full_size: dict[str, Any] | None = None
    exposure: dict[str, Any] | None = None
    unseen: dict[str, float] | None = None
    scale: dict[str, Any] | None = None
    backdrop: int = 0
    matching: dict[str, Any] | None = None
    depth_maps: dict[str, Any] | None = None
    bytes: int | None = None
    regions: list[dict[str, Any]] = field(default_factory=list)
    seams: list[dict[str, Any]] = field(default_factory=list)
    resumed: list[str] = field(default_factory=list)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the optimisation early."""
        return bool(self.tto and self.tto[-1]["interrupted"])

    def as_dict(self) -> dict[str, Any]:
        """The JSON object; `doubts` is the name that `warnings` had until version 0.1, kept for one release."""
        return {**asdict(self), "doubts": self.warnings}

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> "Report":
        """The inverse of `as_dict`; reads reports that have only `doubts`, too."""
        rest = {name: entry for name, entry in entries.items() if name not in ("doubts", "warnings")}
        return cls(**rest, warnings=entries.get("warnings", entries.get("doubts", [])))


def views_entry(used: Sequence[str], left_out: Sequence[LeftOut]) -> dict[str, Any]:
    return {"used": list(used), "left_out": [{"name": photo.name, "why": photo.why} for photo in left_out]}


def seconds_entry(seconds: dict[str, float], total: float | None = None) -> dict[str, float]:
    """Seconds of each stage, and the `total` of the command; their sum where it is None."""
    rounded = {stage: round(spent, 3) for stage, spent in seconds.items()}
    return {**rounded, "total": round(sum(seconds.values()) if total is None else total, 3)}


def settings_entry(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as JSON has them: files and places as text."""
    return {name: _plain(value) for name, value in settings.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return value if isinstance(value, int | float | str | None) else str(value)


def quality_entry(quality: Quality) -> dict[str, Any]:
    """PSNR in dB and SSIM, means and view by view."""
    return {**quality.summary(), "background": quality.background, "views": quality.views}


def heldout_entry(
    protocol: HoldoutProtocol, quality: Quality | None, difference: PoseDifference | None
) -> dict[str, Any] | None:
    """The held-out score, where its cameras come from, and how far the cameras of two passes lie apart."""
    if quality is None:
        return None
    apart = difference and {
        "degrees": round(difference.degrees, 4),
        "pixels": None if difference.pixels is None else round(difference.pixels, 3),
    }
    return {**quality_entry(quality), "cameras": protocol, "pose_difference": apart}


def rescored(scores: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """New scores of a stored scene. Its report's `quality`, `before`, says where the held-out cameras come from."""
    heldout, old = scores["heldout"], before.get("heldout")
    if not heldout or not isinstance(old, dict):
        return scores
    kept = {name: old[name] for name in ("cameras", "pose_difference") if name in old}
    return {**scores, "heldout": {**heldout, **kept}}


def exposure_entry(colours: PhotoColours | None) -> dict[str, Any] | None:
    """The difference between neighbouring photos, in shares of a channel's range, and whether it is corrected."""
    if colours is None:
        return None
    return {"disagreement": round(colours.disagreement, 4), "corrected": not colours.agree}


def matching_entry(matching: Matching | None) -> dict[str, Any] | None:
    """What a network did for pairs of photos that SIFT matches badly; with `advice` where none was here."""
    if matching is None:
        return None
    advice = f"{matching.missing}. Run `{INSTALL}`." if matching.missing else None
    return {**asdict(matching), "matches": list(matching.matches), "advice": advice}


def tto_entries(runs: Sequence[tuple[TtoRun, TtoResult]]) -> list[dict[str, Any]]:
    """For each run: the loss before and after, and the curve [step, seconds, loss, PSNR, Gaussians].

    Loss and PSNR (dB) of the curve are over the views of that step.
    """
    return [_tto_entry(run, result) for run, result in runs]


def _tto_entry(run: TtoRun, result: TtoResult) -> dict[str, Any]:
    curve = [
        [step.step, round(step.seconds, 3), round(step.loss, 5), round(step.psnr, 2), step.gaussians]
        for step in result.history
    ]
    return {
        "space": run.space,
        **asdict(run.settings),
        "loss_before": round(result.loss_before, 5),
        "loss_after": round(result.loss_after, 5),
        "cameras": _cameras_entry(result.cameras_before, result.cameras, result.gaussians),
        "added": result.added,
        "undone": result.undone,
        "interrupted": result.interrupted,
        "curve": curve,
    }


def _cameras_entry(before: Cameras, after: Cameras, gaussians: Gaussians) -> dict[str, float] | None:
    """How much refinement changed the cameras; None where it did not.

    `degrees` is the mean rotation, `shift` the mean translation as a share of the distance between the two cameras that
    are farthest apart, `focal` the focal factor. `pixels` is the mean over the views of the median way that the centres
    of the Gaussians go in the picture.
    """
    if torch.equal(before.w2c, after.w2c):
        return None
    turns = rotation_angles(after.w2c[:, :3, :3].double() @ before.w2c[:, :3, :3].double().mT)
    extent = distances(before.centres, before.centres).max()
    return {
        "degrees": round(float(turns.mean()), 4),
        "shift": round(float((after.centres - before.centres).norm(dim=1).mean() / extent), 5),
        "focal": round(float(after.K[0, 0, 0] / before.K[0, 0, 0]), 5),
        "pixels": round(sum(_way(gaussians.means, before, after, view) for view in range(len(after))) / len(after), 3),
    }


def _way(points: Tensor, before: Cameras, after: Cameras, view: int) -> float:
    """The median way in pixels of those points that the view shows; 0 where it shows none."""
    shown = points[before.sees(points, view) & after.sees(points, view)]
    start, end = (project_points(shown, some.w2c[view], some.K[view]) for some in (before, after))
    return float((end - start).norm(dim=1).median()) if len(shown) else 0.0


def machine() -> str:
    """The machine that times were measured on, with the cores that this process may use."""
    model = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return f"{model}, {counted(cores(), 'core')}, {platform.system()}, Python {platform.python_version()}"
