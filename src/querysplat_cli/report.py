"""What happened: the object that `--json` prints and `report.json` keeps."""

import json
import platform
import resource
from dataclasses import dataclass, field
from typing import Any

from querysplat_cli.holdout import PoseDifference
from querysplat_cli.quality import Quality
from querysplat_cli.scene.views import LeftOut


@dataclass(frozen=True)
class Skipped:
    """Work that was not done because it would change nothing, or could not be done: what, why, saved."""

    what: str
    why: str
    saved: str


@dataclass(frozen=True)
class HeldOutQuality:
    """Held-out scores under both camera protocols; None where one was not measured."""

    cameras: str
    isolated: Quality | None
    joint: Quality | None
    difference: PoseDifference | None

    def summary(self) -> dict[str, Any] | None:
        scores = {"isolated": self.isolated, "joint": self.joint}
        chosen = scores[self.cameras]
        if chosen is None:
            return None
        return {
            **chosen.summary(),
            "cameras": self.cameras,
            **{name: quality.summary() if quality else None for name, quality in scores.items()},
            "pose_difference": self.difference
            and {"degrees": round(self.difference.degrees, 4), "pixels": round(self.difference.pixels, 3)},
            "views": chosen.views,
        }


@dataclass(frozen=True)
class Report:
    """Everything that a user may ask about one run."""

    ply: str
    scene: str
    used: tuple[str, ...]
    views_left_out: tuple[LeftOut, ...]
    gaussians: int
    seconds: dict[str, float]
    input_quality: Quality
    heldout_quality: HeldOutQuality | None
    skipped: tuple[Skipped, ...]
    doubts: tuple[str, ...]
    settings: dict[str, Any]
    tto: dict[str, Any] | None = None
    version: str = field(default="0.1.0")

    def as_dict(self) -> dict[str, Any]:
        heldout = self.heldout_quality.summary() if self.heldout_quality else None
        return {
            "ply": self.ply,
            "scene": self.scene,
            "views": {
                "used": list(self.used),
                "left_out": [{"name": photo.name, "why": photo.why} for photo in self.views_left_out],
            },
            "gaussians": self.gaussians,
            "seconds": {
                **{stage: round(seconds, 3) for stage, seconds in self.seconds.items()},
                "total": round(sum(self.seconds.values()), 3),
            },
            "quality": {"input": {**self.input_quality.summary(), "views": self.input_quality.views}, "heldout": heldout},
            "left_out": [vars(part) for part in self.skipped],
            "doubts": list(self.doubts),
            "tto": self.tto,
            "peak_memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
            "settings": self.settings,
            "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
        }

    def json(self) -> str:
        return json.dumps(self.as_dict(), indent=2)
