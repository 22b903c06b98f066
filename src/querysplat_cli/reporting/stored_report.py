"""The report in a scene folder, checked before anything uses it."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le

from querysplat_cli.runtime.checked_json import STRICT_TYPES, check_types
from querysplat_cli.runtime.choices import Space
from querysplat_cli.runtime.errors import MAKE_AGAIN, QuerySplatError
from querysplat_cli.runtime.json_files import read_json, shown

Count = Annotated[int, Ge(0), Le(1_000_000_000)]


@dataclass(frozen=True)
class _Moved:
    """How far refinement moved the cameras."""

    degrees: float
    shift: float
    focal: float
    pixels: float | None = None


@dataclass(frozen=True)
class _FullSize:
    level: str
    ended: str
    not_kept: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class _Exposure:
    disagreement: float
    corrected: bool


@dataclass(frozen=True)
class _Scale:
    """Where metres come from."""

    source: str
    count: Count
    metres_per_unit: float
    residual_m: float | None


@dataclass(frozen=True)
class _Matching:
    matcher: str
    pairs: Count


@dataclass(frozen=True)
class _Region:
    """One of several regions."""

    photos: Count
    overlap: Count
    gaussians: Count


@dataclass(frozen=True)
class _Seam:
    regions: tuple[Count, Count]
    photos: Count
    psnr: float


@dataclass(frozen=True)
class _Run:
    """One run of test-time optimisation. The curve has [step, seconds, loss, PSNR, Gaussians] of each step."""

    space: Space
    steps: Count
    seconds: float | None
    loss_before: float
    loss_after: float
    cameras: _Moved | None
    added: Count
    undone: Count
    interrupted: bool
    curve: tuple[tuple[int, float, float, float, int], ...]
    max_size: Count = 0


@dataclass(frozen=True)
class _LeftOut:
    name: str
    why: str


@dataclass(frozen=True)
class _Used:
    used: tuple[str, ...]
    left_out: tuple[_LeftOut, ...]


@dataclass(frozen=True)
class _Omission:
    what: str
    why: str
    saved: str
    bytes: int | None
    seconds: float | None
    psnr_lost: float | None


@dataclass(frozen=True)
class _DepthMaps:
    given: Count
    used: Count
    difference: float | None
    per_unit: float | None


@dataclass(frozen=True)
class _Report:
    """What a later run reads of a report. Other entries are kept as they are."""

    __pydantic_config__ = STRICT_TYPES

    ply: str
    scene: str
    views: _Used
    gaussians: Count
    seconds: dict[str, float]
    quality: dict[str, Any]
    left_out: tuple[_Omission, ...]
    tto: tuple[_Run, ...]
    settings: dict[str, bool | int | float | str | list[str] | None]
    peak_memory_gib: float
    machine: str
    memory_estimate_gib: float | None
    full_size: _FullSize | None
    exposure: _Exposure | None = None
    unseen: dict[str, float] | None = None
    scale: _Scale | None = None
    backdrop: Count = 0
    matching: _Matching | None = None
    depth_maps: _DepthMaps | None = None
    bytes: Annotated[int, Ge(0)] | None = None
    regions: tuple[_Region, ...] = ()
    seams: tuple[_Seam, ...] = ()
    resumed: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


KNOWN = frozenset(field.name for field in fields(_Report))
SETTINGS = {"queries": (int, type(None)), "weights": (str, type(None)), "precision": (str,)}
"""The settings of a report that a later run needs, with their types."""


def report_of(folder: Path, gaussians: int) -> dict[str, Any] | None:
    """The report in a scene folder that is whole and that of a scene of so many Gaussians; None where there is none."""
    try:
        report = read_report(folder / "report.json")
    except QuerySplatError:
        return None
    return report if report["gaussians"] == gaussians else None


def backdrop_of(folder: Path, gaussians: int) -> int:
    """How many of a scene's Gaussians, the last ones, are its backdrop by the report; 0 where `report_of` has none."""
    report = report_of(folder, gaussians)
    return int(report.get("backdrop", 0)) if report else 0


def read_report(path: Path) -> dict[str, Any]:
    """The report, as JSON has it. Raises QuerySplatError when it is missing, damaged, or not that of a scene."""
    report: dict[str, Any] = read_json(path, MAKE_AGAIN)
    check_types(path, report, _Report, MAKE_AGAIN)
    if report.get("backdrop", 0) > report["gaussians"]:
        raise QuerySplatError(f"{path} is damaged: its backdrop has more Gaussians than the scene", MAKE_AGAIN)
    unknown = sorted(report.keys() - KNOWN)
    if unknown:
        raise QuerySplatError(f"{path} is damaged: it has an entry {shown(unknown[0])}", MAKE_AGAIN)
    settings = report["settings"]
    wrong = [name for name, kinds in SETTINGS.items() if type(settings.get(name)) not in kinds]
    if wrong:
        raise QuerySplatError(f"{path} is damaged: settings.{wrong[0]} is missing or of another type", MAKE_AGAIN)
    return report
