"""The training loop: samples, gradients, optimiser steps, and a saved state from which it resumes exactly."""

import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.checkpoints import save
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.device import peak_gib, return_freed_memory, to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.splat.lpips import Perceptual
from querysplat_cli.training.config import TrainConfig, from_table
from querysplat_cli.training.data import Draw, RecentResults, Samples
from querysplat_cli.training.journal import Journal, known
from querysplat_cli.training.passes import Sample
from querysplat_cli.training.processes import Processes
from querysplat_cli.training.schedule import Average, RankFilter, grow_queries, rate, trained, weights
from querysplat_cli.training.start import freeze, new_optimiser, starting_model
from querysplat_cli.training.state import TrainState, moments, read_state, restore_moments, write_state
from querysplat_cli.training.step import SampleLoss, StepSettings, add_gradient, anchored

STATE, MODEL = "state.safetensors", "model.safetensors"
ANCHORS_KEPT = 256
"""Samples whose anchors stay in memory. Anchors do not depend on the weights."""
RESUMABLE = ("save_every", "log_every")
"""Settings that may differ when a training is resumed: the weights do not depend on them."""


@dataclass(frozen=True)
class TrainReport:
    """What a run did; seconds are this run's.

    Each step took `batch` samples, shared by `processes`. `skipped` counts samples without a gradient by reason,
    `redrawn` scenes that gave no sample. `loss` and `psnr` are those of the last line of the log, and None without one.
    """

    model: str
    steps: int
    batch: int
    processes: int
    loss: float | None
    psnr: float | None
    skipped: dict[str, int]
    redrawn: int
    seconds: float
    steps_per_second: float
    waiting: float
    peak_memory_gib: float


@dataclass
class _Window:
    """The losses since a line of the log, after `step`, and the seconds of waiting for data."""

    step: int
    begun: float = field(default_factory=time.perf_counter)
    losses: list[SampleLoss] = field(default_factory=list)
    waited: float = 0.0


class Trainer:
    """A model in training. All processes hold the same weights, average and moments at every step."""

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        processes: Processes,
        device: torch.device,
        *,
        resume: bool,
        perceptual: Perceptual | None = None,
    ) -> None:
        """Raises QuerySplatError when another training is in `folder`, its state is damaged, or the processes cannot
        share a batch evenly."""
        samples_in_turn(config.optimiser.batch, processes.world)
        self.config, self.folder, self.processes, self.device = config, folder, processes, device
        self._perceptual = perceptual.to(device) if isinstance(perceptual, nn.Module) else perceptual
        state = read_state(folder / STATE) if resume else None
        if state:
            _check_same(config, from_table(state.facts["config"]), folder)
        self.step = state.step if state else 0
        # At the end of a stage its own tensors are in the state; the next one begins with the next step.
        self._stage, _ = config.at(max(0, self.step - 1))
        self.model = starting_model(config).to(device)
        if state:
            self._grow(config.stages[self._stage].queries)
            self.model.load_state_dict({name: tensor.to(device) for name, tensor in state.part("model").items()})
        freeze(self.model, config)
        self._filter = RankFilter(config.optimiser, state.facts["window"] if state else ())
        self._average = Average(self.model, config.optimiser.ema, state.part("average") if state else None)
        self.skipped: dict[str, int] = dict(state.facts["skipped"]) if state else {}
        if not state:
            self._enter(0)
        self._optimiser = new_optimiser(self.model, self.config.optimiser)
        if state:
            restore_moments(self._optimiser, dict(trained(self.model)), state.part("moments"))
        processes.spread(list(self.model.state_dict().values()))
        if config.optimiser.compile:
            self.model.decode = torch.compile(self.model.decode)  # type: ignore[method-assign]

    def run(self, samples: Samples, *, progress: Progress, tensorboard: bool = False) -> TrainReport:
        """Train to the last step and save now and then. Only the first process writes files.

        Raises QuerySplatError where every sample was skipped."""
        journal = Journal(self.folder, self.step, tensorboard=tensorboard) if self.processes.first else None
        kept: RecentResults[Anchors] = RecentResults(ANCHORS_KEPT)
        row = journal.last() if journal else None
        begun, first, waited = time.perf_counter(), self.step, 0.0
        window = _Window(self.step)
        while self.step < self.config.steps:
            number, before = self.config.at(self.step)
            if number != self._stage:
                self._enter(number)
                self._optimiser = new_optimiser(self.model, self.config.optimiser)
            losses, spent = self._step(samples, kept, before)
            window.losses += losses
            window.waited += spent
            waited += spent
            self.step += 1
            last = self.step == self.config.steps
            if last and sum(self.skipped.values()) == self.step * self.config.optimiser.batch:
                raise QuerySplatError(f"no sample gave a gradient: {'; '.join(self.skipped)}", "Check data.sources.")
            if self.step % self.config.log_every == 0 or last:
                row, window = self._row(window), _Window(self.step)
                return_freed_memory()
                if journal:
                    journal.add(row)
            if self.step % self.config.save_every == 0 or last:
                self._save(journal)
            if row and row["step"] == self.step:
                done = self.step / self.config.steps
                progress(f"loss {row['loss']:.4f}, {row['psnr']:.2f} dB, {row['seconds_per_step']:.2f} s a step", done)
        seconds = time.perf_counter() - begun
        return TrainReport(
            model=str(self.folder / MODEL),
            steps=self.step,
            batch=self.config.optimiser.batch,
            processes=self.processes.world,
            loss=known(row["loss"]) if row else None,
            psnr=known(row["psnr"]) if row else None,
            skipped=self.skipped,
            redrawn=samples.redrawn,
            seconds=seconds,
            steps_per_second=(self.step - first) / max(seconds, 1e-9),
            waiting=waited / max(seconds, 1e-9),
            peak_memory_gib=peak_gib(self.device),
        )

    def _step(self, samples: Samples, kept: RecentResults[Anchors], before: int) -> tuple[list[SampleLoss], float]:
        """One optimiser step. Returns the losses of all samples of the batch, and the seconds of waiting for data."""
        config, stage = self.config, self.config.stages[self._stage]
        waited, results = 0.0, []
        for index in self._indices():
            after = Draw(self.step, index + self.processes.world, stage.inputs)
            if after.index >= config.optimiser.batch:
                next_stage, _ = config.at(self.step + 1)
                after = Draw(self.step + 1, self.processes.rank, config.stages[next_stage].inputs)
            start = time.perf_counter()
            sample, path = samples.get(Draw(self.step, index, stage.inputs), after)
            waited += time.perf_counter() - start
            sample = sample.in_frame(config.model.frame)
            anchors = None
            if self.model.config.queries == "anchored":
                # Not in the reader's thread: the renderer's compiled code cannot run in two threads at once.
                try:
                    anchors = kept.get(path, lambda sample=sample: anchored(sample))  # type: ignore[misc]
                except QuerySplatError as error:  # its masks leave no block
                    results.append(SampleLoss(math.nan, {}, math.nan, 0, error.message))
                    continue
            results.append(self._add(to_device(sample, self.device), to_device(anchors, self.device), index))
        return self._advance(results, rate(self.step - before, stage)), waited

    def _indices(self) -> range:
        """The samples of a batch that are this process's: a batch is the same however many processes share it."""
        return range(self.processes.rank, self.config.optimiser.batch, self.processes.world)

    def _add(self, sample: Sample, anchors: Anchors | None, index: int) -> SampleLoss:
        step = StepSettings(
            self.config,
            weights(self.step, self.config.losses),
            share=1 / self.config.optimiser.batch,
            counts=lambda loss: self._filter.keeps(loss, self.step / self.config.steps),
            perceptual=self._perceptual,
        )
        return add_gradient(self.model, sample, anchors, step, _generator(self.config.seed, self.step, index))

    def _advance(self, own: list[SampleLoss], lr: float) -> list[SampleLoss]:
        """Sum the processes' gradients and take a step, unless all samples were skipped or the sum is not finite.

        Returns the losses of all processes' samples.
        """
        parameters = [parameter for _, parameter in trained(self.model)]
        self.processes.sum_gradients(parameters)
        results = self.processes.gather(own)
        self._filter.add([each.pictures for each in results])
        for each in results:
            if each.skipped:
                self.skipped[each.skipped] = self.skipped.get(each.skipped, 0) + 1
        norm = nn.utils.clip_grad_norm_(parameters, self.config.optimiser.clip)
        if not all(each.skipped for each in results) and bool(norm.isfinite()):
            for group in self._optimiser.param_groups:
                group["lr"] = lr
            self._optimiser.step()
            self._average.update(self.model, self.step)
        self._optimiser.zero_grad(set_to_none=True)
        return results

    def _row(self, window: _Window) -> dict[str, Any]:
        seconds = time.perf_counter() - window.begun
        sound = [each for each in window.losses if not each.skipped] or window.losses
        names = sorted({name for each in sound for name in each.parts})
        mean = {name: sum(each.parts.get(name, 0.0) for each in sound) / len(sound) for name in names}
        return {
            "step": self.step,
            "loss": sum(each.total for each in sound) / len(sound),
            "psnr": sum(each.psnr for each in sound) / len(sound),
            **mean,
            "lr": self._optimiser.param_groups[0]["lr"],
            "gaussians": sum(each.gaussians for each in sound) // len(sound),
            "skipped": sum(self.skipped.values()),
            "seconds_per_step": seconds / max(1, self.step - window.step),
            "waiting": window.waited / max(seconds, 1e-9),
            "peak_memory_gib": round(peak_gib(self.device), 3),
        }

    def _save(self, journal: Journal | None) -> None:
        if journal is None:
            return
        named = dict(trained(self.model))
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"average.{name}": tensor for name, tensor in self._average.values.items()}
        tensors |= {f"moments.{name}": tensor for name, tensor in moments(self._optimiser, named).items()}
        facts = {
            "config": asdict(self.config),
            "window": self._filter.window,
            "skipped": self.skipped,
        }
        save(self.averaged(), self.folder / MODEL)
        journal.draw()
        write_state(self.folder / STATE, TrainState(self.step, tensors, facts))

    def averaged(self) -> QuerySplat:
        """A copy of the model with the averaged weights."""
        with torch.device("meta"):
            copy = QuerySplat(self.model.config)
        tensors = {name: tensor.detach().float() for name, tensor in self.model.state_dict().items()}
        copy.load_state_dict(tensors | self._average.values, assign=True)
        return copy

    def _enter(self, stage: int) -> None:
        self._stage = stage
        before = self.model.config.query_count
        self._grow(self.config.stages[stage].queries)
        if self.model.config.query_count != before:
            freeze(self.model, self.config)
            self._average.fit(self.model)

    def _grow(self, queries: int) -> None:
        if queries and queries != self.model.config.query_count:
            # Other noise each time: with the same, a copy would lie on the earlier copy of its query.
            grow_queries(self.model, queries, _generator(self.config.seed, queries))


def _generator(*numbers: int) -> torch.Generator:
    """Of random numbers that differ wherever one of these does."""
    return torch.Generator().manual_seed(int(np.random.SeedSequence(numbers).generate_state(1)[0]))


def samples_in_turn(batch: int, processes: int) -> int:
    """How many samples of a step each process takes, one after another; raises QuerySplatError for a remainder."""
    if batch % processes:
        raise QuerySplatError(
            f"{processes} processes cannot share a batch of {batch} samples evenly",
            f"Set optimiser.batch to a multiple of {processes}, or start another number of processes.",
        )
    return batch // processes


def _check_same(wanted: TrainConfig, found: TrainConfig, folder: Path) -> None:
    free = {name: getattr(wanted, name) for name in RESUMABLE}
    if replace(found, **free) != wanted:
        raise QuerySplatError(
            f"{folder}: the training there has other settings", "Resume with its own, or choose another --output."
        )
