"""What a training is: one TOML file, or a preset of this package with a few changes."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from querysplat_cli.model.config import ModelConfig
from querysplat_cli.runtime.errors import QuerySplatError

T = TypeVar("T")


@dataclass(frozen=True)
class SourceSettings:
    """Scenes of one kind. `inputs` and `interval` (frames from one input to the next) are the fewest and the most.

    `samples` are drawn of each scene. "free" cameras are found by the encoder, "posed" ones are the dataset's.
    `scenes` and `size` (shortest and longest longer side, in pixels) are for "procedural" scenes, `places` and
    `pictures` for "captured" ones.
    """

    kind: Literal["procedural", "captured"]
    places: tuple[str, ...] = ()
    pictures: str = "images_4"
    scenes: int = 100
    samples: int = 1
    size: tuple[int, int] = (240, 336)
    inputs: tuple[int, int] = (4, 4)
    targets: int = 4
    interval: tuple[int, int] = (1, 3)
    cameras: Literal["free", "posed"] = "free"
    seed: int = 0


@dataclass(frozen=True)
class DataSettings:
    """Samples: passes of the frozen encoder, made once and kept in the folder `cache`."""

    sources: tuple[SourceSettings, ...]
    cache: str = "passes"
    encoder: str = "vggt_omega"
    weights: str | None = None
    max_size: int = 512


@dataclass(frozen=True)
class LossSettings:
    """Weights of the losses (paper, section 3.4, and the appendix on parameters).

    LPIPS comes in after `lpips_start` steps and reaches its weight `lpips_ramp` steps later; the Chamfer loss and the
    opacity floor fall to zero, linearly, over the first `anneal` steps. `chamfer_points` bounds the points of either
    side, drawn anew in each step. `background` is a grey value.
    """

    lpips: float = 0.05
    lpips_start: int = 100_000
    lpips_ramp: int = 10_000
    visibility: float = 1.0
    chamfer: float = 1.0
    chamfer_points: int = 16_384
    opacity_floor: float = 0.1
    alpha_min: float = 0.1
    anneal: int = 20_000
    background: float = 0.5


@dataclass(frozen=True)
class StageSettings:
    """One run of the schedule: linear warm-up over `warm_up` of the steps, then a cosine to zero.

    `queries` is the number of learned queries; a larger one than before is reached by perturbed copies; 0 leaves
    them. Only samples with `inputs` (fewest, most) inputs are drawn.
    """

    steps: int
    lr: float
    queries: int = 0
    inputs: tuple[int, int] = (2, 12)
    warm_up: float = 0.05


@dataclass(frozen=True)
class OptimiserSettings:
    """AdamW and what surrounds it.

    Gradients of `accumulate` samples of each process make a step. Once `keep_from` of all steps are done, a sample
    whose loss ranks above `keep` of the `window` latest ones gives no gradient. `frozen` are beginnings of names of
    tensors that stay as they are.
    """

    weight_decay: float = 0.05
    betas: tuple[float, float] = (0.9, 0.95)
    clip: float = 1.0
    ema: float = 0.9995
    accumulate: int = 1
    keep: float = 0.95
    keep_from: float = 0.5
    window: int = 512
    views_at_once: int = 4
    precision: Literal["fp32", "bf16"] = "bf16"
    compile: bool = False
    frozen: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainConfig:
    """A whole training. `start` "scratch" draws weights, "prior" is the compact model's analytic start, anything else
    is a checkpoint (a preset's name or a file)."""

    data: DataSettings
    stages: tuple[StageSettings, ...]
    model: ModelConfig = field(default_factory=ModelConfig)
    losses: LossSettings = field(default_factory=LossSettings)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)
    start: str = "scratch"
    seed: int = 0
    save_every: int = 1000
    log_every: int = 10

    @property
    def steps(self) -> int:
        return sum(stage.steps for stage in self.stages)

    @property
    def needs_lpips(self) -> bool:
        return self.losses.lpips > 0 and self.steps > self.losses.lpips_start

    def at(self, step: int) -> tuple[int, int]:
        """The number of the stage that `step` belongs to, and the steps before that stage."""
        before = 0
        for number, stage in enumerate(self.stages):
            if step < before + stage.steps:
                return number, before
            before += stage.steps
        return len(self.stages) - 1, before - self.stages[-1].steps


def load_config(source: str, changes: Sequence[str] = ()) -> TrainConfig:
    """The training in a TOML file, or the preset of that name, with `changes` like "optimiser.clip=0.5".

    A file may name the preset that it changes as `base`. Raises QuerySplatError for unknown names and wrong values.
    """
    values = _tables(source)
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals:
            raise QuerySplatError(f"--set {change}: not NAME=VALUE", "For instance --set optimiser.clip=0.5.")
        _put(values, name.strip(), _value(text.strip()))
    config = _built(TrainConfig, values, "")
    _check(config)
    return config


def training_presets() -> list[str]:
    """Names of the trainings that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in _presets().iterdir() if entry.name.endswith(".toml"))


def as_table(config: TrainConfig) -> dict[str, Any]:
    """What a checkpoint keeps of it; `from_table` is the way back."""
    return asdict(config)


def from_table(values: Mapping[str, Any]) -> TrainConfig:
    """The way back from `as_table`, after JSON."""
    return _built(TrainConfig, dict(values), "")


def _presets() -> Any:
    return resources.files("querysplat_cli") / "presets" / "training"


def _tables(source: str) -> dict[str, Any]:
    path = Path(source)
    try:
        if path.suffix == ".toml":
            values = tomllib.loads(path.read_text())
        elif source in training_presets():
            values = tomllib.loads((_presets() / f"{source}.toml").read_text())
        else:
            raise QuerySplatError(
                f"there is no training called '{source}'",
                f"Give a .toml file, or one of: {', '.join(training_presets())}.",
            )
    except (OSError, UnicodeDecodeError) as error:
        raise QuerySplatError(f"{source}: cannot be read: {error}", "Give a TOML file.") from error
    except tomllib.TOMLDecodeError as error:
        raise QuerySplatError(f"{source}: no TOML: {error}", "Mend that line.") from error
    base = values.pop("base", None)
    return _merged(_tables(base), values) if base else values


def _merged(below: dict[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = dict(below)
    for name, value in above.items():
        inner = both.get(name)
        both[name] = _merged(inner, value) if isinstance(value, dict) and isinstance(inner, dict) else value
    return both


def _value(text: str) -> Any:
    """TOML's reading of `text`; what is none, such as a bare word, is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Set a dotted name; numbers step into lists: stages.0.steps."""
    *way, last = name.split(".")
    place: Any = values
    for part in way:
        place = _entry(place, part, name)
    if isinstance(place, list):
        _entry(place, last, name)
        place[int(last)] = value
    elif isinstance(place, dict):
        place[last] = value
    else:
        raise QuerySplatError(
            f"--set {name}: there is nothing inside '{way[-1]}'", "See docs/training.md for the names."
        )


def _entry(place: Any, part: str, name: str) -> Any:
    if isinstance(place, dict):
        return place.setdefault(part, {})
    if isinstance(place, list) and part.isdecimal() and int(part) < len(place):
        return place[int(part)]
    raise QuerySplatError(f"--set {name}: there is no '{part}'", "See docs/training.md for the names.")


def _built(kind: type[T], values: Any, where: str) -> T:
    """A dataclass from tables; raises QuerySplatError that names the field."""
    if not isinstance(values, dict):
        raise QuerySplatError(f"{where or 'the training'} must be a table", "See docs/training.md.")
    types = get_type_hints(kind)
    known = {each.name for each in fields(kind)}  # type: ignore[arg-type]  # a dataclass
    if unknown := sorted(values.keys() - known):
        raise QuerySplatError(f"unknown setting: {where}{unknown[0]}", f"Known are: {', '.join(sorted(known))}.")
    try:
        return kind(**{name: _fitted(types[name], value, f"{where}{name}") for name, value in values.items()})
    except TypeError as error:
        missing = str(error).partition("argument")[2].lstrip("s: ")
        raise QuerySplatError(f"{where or 'the training '}lacks {missing}", "See docs/training.md.") from error


def _fitted(wanted: Any, value: Any, where: str) -> Any:
    """`value` as the type `wanted`: dataclasses, tuples, unions, literals, numbers, texts."""
    kind, parts = get_origin(wanted), get_args(wanted)
    if is_dataclass(wanted) and isinstance(wanted, type):
        return _built(wanted, value, f"{where}.")
    if kind is tuple and isinstance(value, list | tuple):
        inner = [parts[0]] * len(value) if parts[-1] is Ellipsis else list(parts)
        if len(inner) == len(value):
            return tuple(
                _fitted(part, each, f"{where}.{i}") for i, (part, each) in enumerate(zip(inner, value, strict=True))
            )
    elif kind in (Union, UnionType):
        if value is None:
            return None
        return _fitted(next(part for part in parts if part is not type(None)), value, where)
    elif kind is Literal:
        if value in parts:
            return value
        raise QuerySplatError(f"{where} cannot be {value!r}", f"Choose one of: {', '.join(map(str, parts))}.")
    elif wanted is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif isinstance(wanted, type) and isinstance(value, wanted) and isinstance(value, bool) == (wanted is bool):
        return value
    raise QuerySplatError(f"{where} cannot be {value!r}", "See docs/training.md for its type.")


def _check(config: TrainConfig) -> None:
    ranges: list[tuple[str, float, float, float]] = [
        ("optimiser.clip", config.optimiser.clip, 1e-9, 1e9),
        ("optimiser.ema", config.optimiser.ema, 0, 1),
        ("optimiser.accumulate", config.optimiser.accumulate, 1, 1e6),
        ("optimiser.views_at_once", config.optimiser.views_at_once, 1, 1e6),
        ("optimiser.keep", config.optimiser.keep, 0.01, 1),
        ("optimiser.keep_from", config.optimiser.keep_from, 0, 1),
        ("optimiser.window", config.optimiser.window, 1, 1e6),
        ("losses.anneal", config.losses.anneal, 1, 1e9),
        ("losses.chamfer_points", config.losses.chamfer_points, 1, 1e9),
        ("save_every", config.save_every, 1, 1e9),
        ("log_every", config.log_every, 1, 1e9),
    ]
    ranges += [(f"losses.{name}", getattr(config.losses, name), 0, 1e9) for name in ("lpips", "visibility", "chamfer")]
    for i, stage in enumerate(config.stages):
        ranges += [(f"stages.{i}.steps", stage.steps, 1, 1e9), (f"stages.{i}.lr", stage.lr, 0, 1e3)]
        ranges += [(f"stages.{i}.warm_up", stage.warm_up, 0, 1), (f"stages.{i}.queries", stage.queries, 0, 1e6)]
    for i, source in enumerate(config.data.sources):
        name = f"data.sources.{i}"
        ranges += [
            (f"{name}.inputs", source.inputs[0], 2, source.inputs[1]),
            (f"{name}.targets", source.targets, 1, 1e3),
        ]
        ranges += [(f"{name}.interval", source.interval[0], 1, source.interval[1])]
    for label, value, low, high in ranges:
        if not low <= value <= high:
            raise QuerySplatError(f"{label} cannot be {value:g}", f"Choose from {low:g} to {high:g}.")
    if not config.stages or not config.data.sources:
        raise QuerySplatError("a training needs stages and data.sources", "See docs/training.md.")
    learned = [stage.queries for stage in config.stages]
    if config.model.queries == "anchored" and any(learned):
        raise QuerySplatError("stages.queries is for learned queries", "Anchored ones are as many as a scene needs.")
    if config.model.queries == "learned" and (not all(learned) or sorted(learned) != learned):
        raise QuerySplatError("stages.queries must be given and may not fall", "For instance 1024, 2048, 4096, 8192.")


def with_queries(model: ModelConfig, count: int) -> ModelConfig:
    """The same model with so many learned queries; 0 leaves it."""
    return replace(model, query_count=count) if count else model
