"""What a training would take, without doing it."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.device import find_device, peak_gib, tensor_bytes, to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.training.config import DataSettings, SourceSettings, TrainConfig, with_queries
from querysplat_cli.training.data import (
    CachedSamples,
    Draw,
    narrowed,
    no_samples,
    sample_maker,
    sources_of_stages,
    wanted_samples,
)
from querysplat_cli.training.online import OnlineSamples
from querysplat_cli.training.passes import LARGE_FEATURES, Sample, read_sample
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.run import TrainRequest, training_encoder
from querysplat_cli.training.schedule import trained, weights
from querysplat_cli.training.sources import open_source, walked_once
from querysplat_cli.training.start import freeze, starting_model
from querysplat_cli.training.step import StepSettings, add_gradient, anchored
from querysplat_cli.training.trainer import ANCHORS_KEPT, samples_in_turn

Result = TypeVar("Result")
PICTURE_BYTES = 3 + 1
"""Of a pixel in the cache: colours and mask."""
DEPTH_BYTES = 2 + 2
"""Of a pixel of an input: depth and confidence."""


@dataclass(frozen=True)
class StagePlan:
    """The samples of a stage: `inputs` (fewest, most) of each, `drawn` in all its steps, `distinct` among them.

    `distinct` is at most the number that the cache holds. Without a cache, every draw is of other photos.
    """

    steps: int
    inputs: tuple[int, int]
    drawn: int
    distinct: int


@dataclass(frozen=True)
class TrainPlan:
    """What a training will take. Figures that could not be measured are None; `unmeasured` is the reason.

    Each step takes `batch` samples: `in_turn` on each of `processes`. `samples` is the number that the cache will hold,
    of which `ready` are there, and `disk_gib` what all of them take; all three are 0 without a cache. `scenes` are
    those of all sources, and `assumed` says which of them were not found. Gibibytes are of each process, the disk's
    of all.
    """

    parameters: int
    trained: int
    steps: int
    batch: int
    processes: int
    in_turn: int
    stages: tuple[StagePlan, ...]
    scenes: int
    assumed: str
    online: bool
    samples: int
    ready: int
    disk_gib: float
    state_gib: float
    peak_memory_gib: float | None
    seconds_per_sample: float | None
    seconds_per_step: float | None
    hours: float | None
    unmeasured: str


@walked_once()
def plan(request: TrainRequest, stages: Stages) -> TrainPlan:
    """What `train` would take, measured on one sample, made twice, and two steps. Nothing is written.

    Under torchrun, and with WORLD_SIZE, its figures are for so many processes.
    """
    config, device = request.config, find_device(request.device)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    in_turn = samples_in_turn(config.optimiser.batch, processes)
    last = with_queries(config.model, config.stages[-1].queries)
    with torch.device("meta"):
        model = QuerySplat(last)
    freeze(model, config)
    whole = sum(parameter.numel() for parameter in model.parameters())
    learning = sum(parameter.numel() for _, parameter in trained(model))
    scenes, assumed = _scene_counts(config.data.sources)
    cached = [] if config.data.online else sources_of_stages(config.data, config.stages)
    held = [_scenes_of(source, config.data.sources, scenes) * source.samples for source in cached]
    ready = sum(_ready(config.data, source) for source in cached)
    sample_bytes = [_sample_bytes(source, config.model, config.data.max_size) for source in cached]
    measured = _measured(config, device, cached=0 < ready == sum(held), stages=stages)
    others = max(0, min(ANCHORS_KEPT, sum(held)) - 1) * measured.anchors / 2**30 if device.type == "cpu" else 0.0
    hours = None
    if measured.step is not None:
        made = sum(held) - ready if cached else config.steps * config.optimiser.batch
        taken = (measured.sample or 0.0) * made + measured.step * config.steps * config.optimiser.batch
        hours = taken / 3600 / processes
    return TrainPlan(
        parameters=whole,
        trained=learning,
        steps=config.steps,
        batch=config.optimiser.batch,
        processes=processes,
        in_turn=in_turn,
        stages=_stages(config, scenes),
        scenes=sum(scenes),
        assumed=assumed,
        online=config.data.online,
        samples=sum(held),
        ready=ready,
        disk_gib=sum(count * each for count, each in zip(held, sample_bytes, strict=True)) / 2**30,
        # Weights, and for those that learn gradient, two moments and the average, in float32.
        state_gib=4 * (whole + 4 * learning) / 2**30,
        peak_memory_gib=peak_gib(device) + others if measured.step is not None else None,
        seconds_per_sample=measured.sample,
        seconds_per_step=None if measured.step is None else measured.step * in_turn,
        hours=hours,
        unmeasured=measured.reason,
    )


def _scene_counts(sources: Sequence[SourceSettings]) -> tuple[list[int], str]:
    """Scenes of each source, and a sentence where they had to be assumed."""
    counts, assumed = [], ""
    for source in sources:
        try:
            counts.append(len(open_source(source)))
        except QuerySplatError as error:
            counts.append(source.scenes)
            assumed = f"{source.scenes:,} scenes: {error.message}"
    return counts, assumed


def _ready(data: DataSettings, source: SourceSettings) -> int:
    """Samples of a source that are in the cache; 0 where the source is not found."""
    try:
        return sum(each.path.is_file() for each in wanted_samples(data, [source]))
    except QuerySplatError:
        return 0


def _scenes_of(source: SourceSettings, originals: Sequence[SourceSettings], scenes: Sequence[int]) -> int:
    """Scenes of a source that was narrowed to the inputs of a stage."""
    same = (replace(each, inputs=source.inputs) == source for each in originals)
    return next(count for count, fits in zip(scenes, same, strict=True) if fits)


def _stages(config: TrainConfig, scenes: Sequence[int]) -> tuple[StagePlan, ...]:
    found = []
    for stage in config.stages:
        drawn = stage.steps * config.optimiser.batch
        held = sum(
            _scenes_of(source, config.data.sources, scenes) * source.samples
            for source in narrowed(config.data.sources, stage.inputs)
        )
        found.append(StagePlan(stage.steps, stage.inputs, drawn, drawn if config.data.online else min(drawn, held)))
    return tuple(found)


def _sample_bytes(source: SourceSettings, model: ModelConfig, max_size: int) -> float:
    """About the bytes of a sample in the cache, with as many inputs as the mean."""
    inputs, pixels = sum(source.inputs) / 2, float(max_size**2)
    if source.kind == "procedural":
        side = min(max_size, sum(source.size) / 2)
        pixels = side**2 * sum(TRAINING_POLICY.aspect) / 2
    tokens = model.special_tokens + pixels / model.patch**2
    number = 2 if model.vgm_width > LARGE_FEATURES else 4
    features = model.mixed_layers * tokens * model.vgm_width * number
    return inputs * (features + pixels * (PICTURE_BYTES + DEPTH_BYTES)) + source.targets * pixels * PICTURE_BYTES


@dataclass(frozen=True)
class _Measured:
    """Seconds to make a sample (None where all are in the cache) and to step on one, and the bytes of its anchors; or
    the reason for no figure."""

    sample: float | None = None
    step: float | None = None
    anchors: int = 0
    reason: str = ""


def _measured(config: TrainConfig, device: torch.device, *, cached: bool, stages: Stages) -> _Measured:
    with stages("measure"):
        try:
            sample, seconds = _one_sample(config, device, cached=cached)
            sample = sample.in_frame(config.model.frame)
            anchors = anchored(sample) if config.model.queries == "anchored" else None
        except QuerySplatError as error:
            return _Measured(reason=f"{error.message}: {error.hint}")
        model = starting_model(config)
        freeze(model, config)
        moved = to_device((sample, anchors), device)
        return _Measured(seconds, _seconds_of_step(config, model.to(device), *moved), tensor_bytes(anchors))


def _one_sample(config: TrainConfig, device: torch.device, *, cached: bool) -> tuple[Sample, float | None]:
    """A sample of the cache, or a new one and the seconds that it takes."""
    draw = Draw(0, 0, config.stages[0].inputs)
    if cached:
        return CachedSamples(config.data, config.seed).get(draw)[0], None
    encoder = training_encoder(config.data, device)
    if config.data.online:
        return _second_of_two(lambda: OnlineSamples(config.data, config.seed, lambda: encoder).get(draw)[0])
    with scratch_folder() as scratch:
        data = replace(config.data, cache=str(scratch), sources=tuple(narrowed(config.data.sources, draw.inputs)[:1]))
        wanted = wanted_samples(data, data.sources)
        if not wanted:
            raise no_samples(config.data, draw.inputs)

        def make() -> None:
            sample_maker((data, lambda: encoder))(wanted[0])
            if wanted[0].reason.is_file():
                raise QuerySplatError("the first sample cannot be made", wanted[0].reason.read_text())

        _, seconds = _second_of_two(make)
        return read_sample(wanted[0].path), seconds


def _seconds_of_step(config: TrainConfig, model: QuerySplat, sample: Sample, anchors: Anchors | None) -> float:
    """Seconds of a step on one sample."""

    def step() -> None:
        generator = torch.Generator().manual_seed(0)
        add_gradient(model, sample, anchors, StepSettings(config, weights(0, config.losses)), generator)

    return _second_of_two(step)[1]


def _second_of_two(do: Callable[[], Result]) -> tuple[Result, float]:
    """What `do` returns the second time, and the seconds of that. The first one is slower, because it compiles."""
    do()
    start = time.perf_counter()
    result = do()
    return result, time.perf_counter() - start
