"""`querysplat train`: prepare the samples, and train."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.cluster import find_engine
from querysplat_cli.runtime.device import find_device
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.runtime.threads import cores
from querysplat_cli.runtime.workers import Workers
from querysplat_cli.scene.files import refuse_existing, sole_writer, writable
from querysplat_cli.splat.lpips import Perceptual
from querysplat_cli.training.config import DataSettings, TrainConfig
from querysplat_cli.training.data import (
    CachedSamples,
    PreparedSamples,
    Samples,
    no_samples,
    prepare_samples,
    sources_of_stages,
)
from querysplat_cli.training.journal import check_tensorboard
from querysplat_cli.training.online import OnlineSamples
from querysplat_cli.training.processes import Processes, joined_processes
from querysplat_cli.training.sources import notes_of, walked_once
from querysplat_cli.training.trainer import MODEL, STATE, Trainer, TrainReport


@dataclass(frozen=True)
class TrainRequest:
    """The options of `querysplat train`. `perceptual` is LPIPS, or None without its weights.

    `workers` processes make the samples of the cache; None takes one for each core with the classical encoder, and one
    with a learned encoder, which fills a GPU. `cluster` lets Dask make them (`runtime/cluster.py`). Nothing is trained
    with `samples_only`.
    """

    config: TrainConfig
    output: Path
    resume: bool = False
    force: bool = False
    device: str = "auto"
    tensorboard: bool = False
    perceptual: Perceptual | None = None
    workers: int | None = None
    samples_only: bool = False
    cluster: str | None = None


@walked_once()
def train(request: TrainRequest, stages: Stages) -> TrainReport | PreparedSamples | None:
    """Make the missing samples, and train. Only the first of several processes returns a report.

    With `samples_only`, the report is what the cache holds.
    Raises QuerySplatError on bad input and MissingPart when weights are missing. The training itself is checked first,
    as samples may take hours.
    """
    config, folder = request.config, request.output
    device = find_device(request.device)
    with joined_processes(device) as processes, ExitStack() as stack:
        if device.type == "cuda":
            device = torch.device("cuda", processes.local)
            torch.cuda.set_device(device)
        if not request.resume and not request.samples_only:
            refuse_existing([folder / STATE, folder / MODEL], force=request.force)
        if request.tensorboard:
            check_tensorboard()
        stack.enter_context(writable(folder))
        if processes.first:
            stack.enter_context(sole_writer(folder))
        processes.wait()
        trainer = None
        if not request.samples_only:
            with stages("model"):
                trainer = Trainer(
                    config, folder, processes, device, resume=request.resume, perceptual=request.perceptual
                )
        with stages("samples") as progress:
            samples, prepared = _samples(request, processes, device, stages, progress)
        if trainer is None:
            return prepared if processes.first else None
        with stages("train") as progress:
            report = _trained(request, trainer, samples, progress)
        processes.wait()
    return report if processes.first else None


def _trained(request: TrainRequest, trainer: Trainer, samples: Samples, progress: Progress) -> TrainReport:
    """Take the steps. The state of a training that is replaced goes first: `--resume` would go on with that one."""
    state = request.output / STATE
    if request.force and not request.resume and trainer.processes.first:
        state.unlink(missing_ok=True)
    try:
        return trainer.run(samples, progress=progress, tensorboard=request.tensorboard)
    except KeyboardInterrupt:
        if state.is_file():
            signals.keep(f"The last saved state is in {request.output}; --resume goes on with it.")
        raise


def _samples(
    request: TrainRequest, processes: Processes, device: torch.device, stages: Stages, progress: Progress
) -> tuple[Samples, PreparedSamples]:
    """Where the samples of the steps come from, and those of the cache, which are made first.

    Raises QuerySplatError when a stage has none.
    """
    config = request.config
    if processes.first:
        for note in notes_of(sources_of_stages(config.data, config.stages)):
            stages.say(note)
    make = partial(training_encoder, config.data, device)
    if config.data.online:
        progress("made in each step", 1.0)
        return OnlineSamples(config.data, config.seed, make), PreparedSamples(0, ())
    data = replace(config.data, sources=tuple(sources_of_stages(config.data, config.stages)))
    workers = request.workers or (max(1, cores() // processes.world) if data.encoder == "classical" else 1)
    engine = find_engine(request.cluster, Workers(workers) if workers > 1 else None, stages.say)
    prepared = prepare_samples(
        data, make, rank=processes.rank, world=processes.world, wait=processes.wait, engine=engine, progress=progress
    )
    samples = CachedSamples(config.data, config.seed)
    for stage in config.stages:
        if not samples.paths(stage.inputs):
            raise no_samples(config.data, stage.inputs)
    progress(f"{prepared.ready} ready, {len(prepared.failed)} impossible", 1.0)
    return samples, prepared


def training_encoder(data: DataSettings, device: torch.device) -> Encoder:
    """The frozen VGM of a training, with cameras as it predicts them."""
    folder = Path(data.weights).expanduser() if data.weights else None
    return find_encoder(data.encoder, EncoderOptions(weights=folder, device=device))
