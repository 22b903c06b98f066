"""Files of results, checked before anything uses them.

Entries with a default are missing in results of older versions.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from querysplat_cli.evaluation.results import REMOVE, read_json
from querysplat_cli.runtime.checked_json import STRICT_TYPES, check_types

Count = Annotated[int, Ge(0)]
Scores = dict[str, float | None]


@dataclass(frozen=True)
class _Split:
    num_input_views: Count
    scale: str


@dataclass(frozen=True)
class RunConfig:
    """run_config.json of a row and split."""

    __pydantic_config__ = STRICT_TYPES

    protocol: str
    split: _Split
    lpips: dict[str, str]
    machine: str


@dataclass(frozen=True)
class _Frame:
    name: str


@dataclass(frozen=True)
class Metrics:
    """metrics.json of a case, by groups of views."""

    __pydantic_config__ = STRICT_TYPES

    frames: dict[str, list[_Frame]]
    per_view: dict[str, list[Scores]]
    mean: dict[str, Scores]
    missing: dict[str, dict[str, Any]]
    apart: dict[str, list[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Timing:
    """timing.json of a case."""

    __pydantic_config__ = STRICT_TYPES

    seconds: dict[str, float]
    gaussians: float | None
    peak_memory_gib: float | None


@dataclass(frozen=True)
class Failure:
    """failure.json of a case without scores."""

    __pydantic_config__ = STRICT_TYPES

    error: str
    asked: dict[str, Count] = field(default_factory=dict)
    apart: dict[str, list[str]] = field(default_factory=dict)


def read_checked(path: Path, kind: type) -> dict[str, Any]:
    """The content of `path`, as JSON has it. Raises QuerySplatError where it cannot be read or is no `kind`."""
    content: dict[str, Any] = read_json(path)
    check_types(path, content, kind, REMOVE)
    return content
