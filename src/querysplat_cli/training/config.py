"""What a training is: one TOML file, or a preset of this package with a few changes."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Interval

from querysplat_cli.model.config import ModelConfig
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.tables import STRICT, from_tables

MOST_BASES = 20
"""The longest chain of trainings that are each based on the next."""


@dataclass(frozen=True)
class SourceSettings:
    """Scenes of one kind. `inputs` and `interval` (frames from one input to the next) are the least and the greatest.

    `samples` are drawn of each scene for the cache, for every range of inputs that a stage asks for. "free" cameras are
    found by the encoder, "posed" ones are the dataset's. `scenes` is the number of "procedural" scenes; for "captured"
    ones it is the number that --dry-run counts with where the places are missing. `size` (shortest and longest longer
    side, in pixels) is for "procedural" scenes, `places` and `pictures` are for "captured" ones. `varied` procedural
    scenes are more different from each other: tables, fences, dark and glossy things, more noise and changing colours.
    """

    kind: Literal["procedural", "captured"]
    places: tuple[str, ...] = ()
    pictures: str = "images_4"
    scenes: Annotated[int, Ge(1)] = 100
    samples: Annotated[int, Ge(1)] = 1
    size: tuple[Annotated[int, Ge(48)], int] = (240, 336)
    inputs: tuple[Annotated[int, Ge(2)], int] = (4, 4)
    targets: Annotated[int, Ge(1)] = 4
    interval: tuple[Annotated[int, Ge(1)], int] = (1, 3)
    cameras: Literal["free", "posed"] = "free"
    seed: Annotated[int, Ge(0)] = 0
    varied: bool = False


@dataclass(frozen=True)
class DataSettings:
    """Samples: passes of the frozen encoder over the inputs, and targets.

    By default they are made once and kept in the folder `cache`. With `online`, each is made in the step that uses it,
    of inputs drawn anew: a learned encoder's passes fill disks, and take little time on a GPU.
    """

    sources: tuple[SourceSettings, ...]
    online: bool = False
    cache: str = "passes"
    encoder: str = "vggt_omega"
    weights: str | None = None
    max_size: Annotated[int, Ge(48)] = 512


@dataclass(frozen=True)
class LossSettings:
    """Weights of the losses (paper, section 3.4, and the appendix on parameters).

    A centre that no view sees costs at most `visibility_limit`, and beyond that it gets no gradient, as in TokenGS;
    0 sets no limit. LPIPS comes in after `lpips_start` steps and reaches its weight `lpips_ramp` steps later; the
    Chamfer loss and the opacity floor fall to zero, linearly, over the first `anneal` steps. `chamfer_points` bounds
    the points of either side, drawn anew in each step. `background` is a grey value, or "random": another
    colour in each step.
    """

    lpips: Annotated[float, Ge(0)] = 0.05
    lpips_start: Annotated[int, Ge(0)] = 100_000
    lpips_ramp: Annotated[int, Ge(0)] = 10_000
    visibility: Annotated[float, Ge(0)] = 1.0
    visibility_limit: Annotated[float, Ge(0)] = 1.0
    chamfer: Annotated[float, Ge(0)] = 1.0
    chamfer_points: Annotated[int, Ge(1)] = 16_384
    opacity_floor: Annotated[float, Ge(0)] = 0.1
    alpha_min: Annotated[float, Gt(0)] = 0.1
    anneal: Annotated[int, Ge(1)] = 20_000
    background: Annotated[float, Interval(ge=0, le=1)] | Literal["random"] = 0.5


@dataclass(frozen=True)
class StageSettings:
    """One run of the schedule: linear warm-up over `warm_up` of the steps, then a cosine to zero.

    `queries` is the number of learned queries; a larger one than before is reached by perturbed copies; 0 leaves
    them. Samples with `inputs` (fewest, most) inputs are drawn.
    """

    steps: Annotated[int, Ge(1)]
    lr: Annotated[float, Ge(0)]
    queries: Annotated[int, Ge(0)] = 0
    inputs: tuple[int, int] = (2, 12)
    warm_up: Annotated[float, Interval(ge=0, le=1)] = 0.05


@dataclass(frozen=True)
class OptimiserSettings:
    """AdamW and what surrounds it.

    A step takes the mean gradient of `batch` samples, which the processes share evenly; each process adds up its share
    one sample after another. `weight_decay` acts on matrices outside of the heads, and on nothing else. `ema` is the
    decay of the average of the weights; in step t it is at most (1 + t) / (10 + t), so that the initial weights fade.
    Once `keep_from` of all steps are done, a sample whose picture loss ranks above `keep` of the `window` latest ones
    gives no gradient. `frozen` are beginnings of names of tensors that stay as they are.
    """

    weight_decay: Annotated[float, Ge(0)] = 0.05
    betas: tuple[Annotated[float, Interval(ge=0, lt=1)], Annotated[float, Interval(ge=0, lt=1)]] = (0.9, 0.95)
    clip: Annotated[float, Gt(0)] = 1.0
    ema: Annotated[float, Interval(ge=0, le=1)] = 0.9995
    batch: Annotated[int, Ge(1)] = 1
    keep: Annotated[float, Interval(ge=0.01, le=1)] = 0.95
    keep_from: Annotated[float, Interval(ge=0, le=1)] = 0.5
    window: Annotated[int, Ge(1)] = 512
    views_at_once: Annotated[int, Ge(1)] = 4
    precision: Literal["fp32", "bf16"] = "bf16"
    compile: bool = False
    frozen: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainConfig:
    """A whole training. `start` "scratch" draws weights, "prior" is the compact model's analytic start, anything else
    is a checkpoint (a preset's name or a file)."""

    __pydantic_config__ = STRICT

    data: DataSettings
    stages: tuple[StageSettings, ...]
    model: ModelConfig = field(default_factory=ModelConfig)
    losses: LossSettings = field(default_factory=LossSettings)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)
    start: str = "scratch"
    seed: Annotated[int, Ge(0)] = 0
    save_every: Annotated[int, Ge(1)] = 1000
    log_every: Annotated[int, Ge(1)] = 10

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
    config = from_table(values)
    _check(config)
    return config


def training_presets() -> list[str]:
    """Names of the trainings that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in _presets().iterdir() if entry.name.endswith(".toml"))


def from_table(values: Mapping[str, Any]) -> TrainConfig:
    """The training of the tables that `asdict` makes of one. Raises QuerySplatError as `load_config` does."""
    return from_tables(TrainConfig, values, what="training", docs="docs/training.md")


def _presets() -> Any:
    return resources.files("querysplat_cli") / "presets" / "training"


def _tables(source: str, below: tuple[str, ...] = ()) -> dict[str, Any]:
    """The tables of a training, on those of its base. `below` are the trainings that are based on this one."""
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
    except (ValueError, RecursionError) as error:  # numbers of too many digits; values nested too deeply
        raise QuerySplatError(f"{source}: no TOML: {error}", "Mend that line.") from error
    base = values.pop("base", None)
    if base is None:
        return values
    if not isinstance(base, str) or base in below or len(below) > MOST_BASES:
        raise QuerySplatError(f"{source}: its base {shown(base)} is no other training", "Name another one.")
    return _merged(_tables(base, (*below, base)), values)


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
    except (ValueError, RecursionError) as error:
        raise QuerySplatError(f"--set: {shown(text)} cannot be read: {error}", "Give a shorter value.") from None


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


def _check(config: TrainConfig) -> None:
    """Raise QuerySplatError for settings that contradict each other; each by itself is in its range."""
    for i, source in enumerate(config.data.sources):
        for name in ("inputs", "interval", "size"):
            fewest, most = getattr(source, name)
            if fewest > most:
                raise QuerySplatError(
                    f"data.sources.{i}.{name} cannot be [{fewest}, {most}]", "Give the smaller number first."
                )
        if source.kind == "captured" and not source.places:
            why = f"data.sources.{i} is captured, and has no places"
            raise QuerySplatError(why, f"""Name some with --set 'data.sources.{i}.places=["/path/to/scenes"]'.""")
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
