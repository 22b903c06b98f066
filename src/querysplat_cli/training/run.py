"""`querysplat train`: prepare the samples and train, or only estimate what that would take."""

import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.device import find_device, peak_gib, to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.files import check_writable, refuse_existing, sole_writer
from querysplat_cli.training.config import DataSettings, TrainConfig
from querysplat_cli.training.data import Samples, prepare_samples
from querysplat_cli.training.journal import check_tensorboard
from querysplat_cli.training.losses import Perceptual
from querysplat_cli.training.passes import Sample
from querysplat_cli.training.processes import joined_processes
from querysplat_cli.training.schedule import trained, weights
from querysplat_cli.training.sources import open_source
from querysplat_cli.training.step import StepSettings, add_gradient, anchored
from querysplat_cli.training.trainer import MODEL, STATE, Trainer, TrainReport, freeze, starting_model


@dataclass(frozen=True)
class TrainRequest:
    """The options of `querysplat train`. `perceptual` is LPIPS, or None without its weights."""

    config: TrainConfig
    output: Path
    resume: bool = False
    force: bool = False
    device: str = "auto"
    tensorboard: bool = False
    perceptual: Perceptual | None = None


@dataclass(frozen=True)
class TrainPlan:
    """What a training will take. Figures that could not be measured are None; `unmeasured` is the reason."""

    parameters: int
    trained: int
    steps: int
    samples: int
    ready: int
    state_gib: float
    peak_memory_gib: float | None
    seconds_per_sample: float | None
    seconds_per_step: float | None
    hours: float | None
    unmeasured: str

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def train(request: TrainRequest, stages: Stages) -> TrainReport | None:
    """Make the missing samples, and train. Only the first of several processes returns a report.

    Raises QuerySplatError on bad input and MissingPart when weights are missing.
    """
    config, folder = request.config, request.output
    device = find_device(request.device)
    with joined_processes(device) as processes, ExitStack() as stack:
        if device.type == "cuda":
            device = torch.device("cuda", processes.local)
            torch.cuda.set_device(device)
        if not request.resume:
            refuse_existing([folder / STATE, folder / MODEL], force=request.force)
        if request.tensorboard:
            check_tensorboard()
        check_writable(folder)
        if processes.first:
            stack.enter_context(sole_writer(folder))
        processes.wait()
        with stages("samples") as progress:
            prepared = prepare_samples(
                config.data,
                partial(_encoder, config.data, device),
                rank=processes.rank,
                world=processes.world,
                progress=progress,
            )
            processes.wait()
            samples = Samples(config.data, config.seed)
            progress(f"{len(samples)} ready, {len(prepared.failed)} impossible", 1.0)
        with stages("train") as progress:
            trainer = Trainer(config, folder, processes, device, resume=request.resume, perceptual=request.perceptual)
            report = trainer.run(samples, progress=progress, tensorboard=request.tensorboard)
        processes.wait()
    return report if processes.first else None


def plan(request: TrainRequest, stages: Stages) -> TrainPlan:
    """What `train` would take, measured on one sample and two steps. Nothing is written."""
    config = request.config
    device = find_device(request.device)
    # A place that is not there is said at once, and not after the model was made.
    sources = [(open_source(source), source.samples) for source in config.data.sources]
    model = starting_model(config)
    freeze(model, config)
    whole = sum(parameter.numel() for parameter in model.parameters())
    learning = sum(parameter.numel() for _, parameter in trained(model))
    total = sum(len(source) * samples for source, samples in sources)
    try:
        ready = len(Samples(config.data, config.seed))
    except QuerySplatError:
        ready = 0
    per_sample = per_step = None
    unmeasured = ""
    with stages("measure"):
        try:
            sample, per_sample = _one_sample(config, device, ready)
            per_step = _seconds_of_step(config, model.to(device), to_device(sample, device))
        except QuerySplatError as error:
            unmeasured = error.message
    hours = None
    if per_step is not None:
        preparing = (per_sample or 0.0) * (total - ready)
        hours = (preparing + per_step * config.steps * config.optimiser.accumulate) / 3600
    return TrainPlan(
        parameters=whole,
        trained=learning,
        steps=config.steps,
        samples=total,
        ready=ready,
        # Weights, and for those that learn gradient, two moments and the average, in float32.
        state_gib=4 * (whole + 4 * learning) / 2**30,
        peak_memory_gib=peak_gib(device) if per_step is not None else None,
        seconds_per_sample=per_sample,
        seconds_per_step=per_step,
        hours=hours,
        unmeasured=unmeasured,
    )


def _encoder(data: DataSettings, device: torch.device) -> Encoder:
    folder = Path(data.weights).expanduser() if data.weights else None
    return find_encoder(data.encoder, EncoderOptions(weights=folder, device=device))


def _one_sample(config: TrainConfig, device: torch.device, ready: int) -> tuple[Sample, float | None]:
    """A sample of the cache, or a new one and the seconds that it took."""
    if ready:
        samples = Samples(config.data, config.seed)
        return samples.read(samples.path(0, 0, 0, config.stages[0].inputs)), None
    encoder = _encoder(config.data, device)
    with scratch_folder() as scratch:
        data = replace(config.data, cache=str(scratch), sources=(replace(config.data.sources[0], scenes=1, samples=1),))
        start = time.perf_counter()
        prepare_samples(data, lambda: encoder, progress=lambda text, fraction: None)
        seconds = time.perf_counter() - start
        samples = Samples(data, config.seed)
        return samples.read(samples.path(0, 0, 0, (1, 1 << 30))), seconds


def _seconds_of_step(config: TrainConfig, model: QuerySplat, sample: Sample) -> float:
    """Seconds of the second of two steps. The first one is slower, because it compiles."""
    anchors = anchored(sample) if model.config.queries == "anchored" else None
    seconds = 0.0
    for _ in range(2):
        start = time.perf_counter()
        generator = torch.Generator().manual_seed(0)
        add_gradient(model, sample, anchors, StepSettings(config, weights(0, config.losses)), generator)
        seconds = time.perf_counter() - start
    return seconds
