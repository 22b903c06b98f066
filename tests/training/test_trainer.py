"""A killed training resumes exactly, on one process and on two, and a batch that is not finite does no harm."""

import json
import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch
from safetensors.torch import load_file

from querysplat_cli.model.checkpoints import load_file as load_model
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.splat.render import render
from querysplat_cli.training.config import LossSettings, OptimiserSettings, StageSettings, TrainConfig
from querysplat_cli.training.data import CachedSamples, Draw
from querysplat_cli.training.journal import Journal
from querysplat_cli.training.processes import Processes
from querysplat_cli.training.schedule import weights
from querysplat_cli.training.start import starting_model
from querysplat_cli.training.step import StepSettings, add_gradient, anchored, decoded
from querysplat_cli.training.trainer import MODEL, STATE, Trainer, samples_in_turn
from training_scenes import TINY, run, sample, toml, training

CPU = torch.device("cpu")


class Stop(Exception):
    pass


def stopped(config: TrainConfig, folder: Path, after: int) -> None:
    """The same training, ended by an exception once `after` steps are done."""

    def stop(text: str, fraction: float) -> None:
        if round(fraction * config.steps) == after:
            raise Stop

    folder.mkdir()
    trainer = Trainer(config, folder, Processes(), CPU, resume=False)
    with pytest.raises(Stop):
        trainer.run(CachedSamples(config.data, config.seed), progress=stop)


def assert_same_weights(one: Path, other: Path) -> None:
    for name in (STATE, MODEL):
        first, second = load_file(one / name), load_file(other / name)
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first), name


@pytest.mark.parametrize("after", [3, 5])
def test_stopped_and_resumed_gives_the_same_bits(tmp_path: Path, after: int) -> None:
    config = training(tmp_path / "cache")
    run(config, tmp_path / "whole")
    stopped(config, tmp_path / "parts", after)
    report = run(config, tmp_path / "parts", resume=True)
    assert report.steps == 6
    assert_same_weights(tmp_path / "whole", tmp_path / "parts")
    steps = [json.loads(line)["step"] for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert steps == [1, 2, 3, 4, 5, 6]
    assert (tmp_path / "parts" / "curve.png").stat().st_size > 5000


def test_resuming_a_finished_training_reports_its_last_line(tmp_path: Path) -> None:
    """Its loss was NaN, which JSON does not have."""
    config = training(tmp_path / "cache", stages=(StageSettings(steps=2, lr=1e-3),))
    first = run(config, tmp_path / "run")
    again = run(config, tmp_path / "run", resume=True)
    assert (again.loss, again.psnr) == (first.loss, first.psnr)
    (tmp_path / "run" / "log.jsonl").unlink()
    assert run(config, tmp_path / "run", resume=True).loss is None


def test_training_changes_what_is_not_frozen_and_nothing_else(tmp_path: Path) -> None:
    config = training(tmp_path / "cache")
    config = replace(config, optimiser=replace(config.optimiser, frozen=("geometry_head", "photo_embedding")))
    run(config, tmp_path / "run")
    before, after = starting_model(config).state_dict(), load_file(tmp_path / "run" / STATE)
    for name, tensor in before.items():
        same = torch.equal(tensor, after[f"model.{name}"])
        assert same or not name.startswith(config.optimiser.frozen), name
    assert not torch.equal(before["appearance_head.weight"], after["model.appearance_head.weight"])
    load_model(tmp_path / "run" / MODEL)


def test_resuming_another_training_or_none_is_refused(tmp_path: Path) -> None:
    config = training(tmp_path / "cache", stages=(StageSettings(steps=2, lr=1e-3),))
    with pytest.raises(QuerySplatError, match="no training"):
        run(config, tmp_path / "run", resume=True)
    run(config, tmp_path / "run")
    with pytest.raises(QuerySplatError, match="other settings"):
        run(replace(config, seed=9), tmp_path / "run", resume=True)
    run(replace(config, save_every=5), tmp_path / "run", resume=True)
    (tmp_path / "run" / STATE).write_bytes(b"cut off")
    with pytest.raises(QuerySplatError, match="not a readable"):
        run(config, tmp_path / "run", resume=True)


def test_a_batch_that_is_not_finite_is_skipped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = training(tmp_path / "cache", save_every=1)
    clean = CachedSamples.get
    calls = 0

    def poisoned(self: CachedSamples, draw: Draw, following: Draw | None = None):  # type: ignore[no-untyped-def]
        nonlocal calls
        calls += 1
        found, path = clean(self, draw, following)
        if calls != 3:
            return found, path
        images = found.targets.images.clone()
        images[0, 0, 5, 5] = math.nan
        return replace(found, targets=replace(found.targets, images=images)), path

    def peek(text: str, fraction: float) -> None:
        if round(6 * fraction) in (2, 3):
            state = trainer.model.state_dict(), trainer.averaged().state_dict()
            states.append([{name: tensor.clone() for name, tensor in each.items()} for each in state])

    monkeypatch.setattr(CachedSamples, "get", poisoned)
    states: list[list[dict[str, torch.Tensor]]] = []
    (tmp_path / "run").mkdir()
    trainer = Trainer(config, tmp_path / "run", Processes(), CPU, resume=False)
    report = trainer.run(CachedSamples(config.data, config.seed), progress=peek)
    assert report.skipped == {"the loss or its gradient is not finite": 1}
    before, after = states
    for own, other in zip(before, after, strict=True):
        assert all(torch.equal(own[name], other[name]) for name in own)
    assert all(tensor.isfinite().all() for tensor in load_file(tmp_path / "run" / STATE).values())


def test_views_a_few_at_once_give_the_gradient_of_all_at_once(tmp_path: Path) -> None:
    config = training(tmp_path / "cache")
    scene = sample(0, targets=3)
    gradients = []
    for at_once in (1, 2, 3):
        torch.manual_seed(0)
        model = starting_model(config)
        some = replace(config, optimiser=replace(config.optimiser, views_at_once=at_once))
        step = StepSettings(some, weights(0, config.losses), share=0.5)
        assert not add_gradient(model, scene, anchored(scene), step, torch.Generator()).skipped
        gradients.append(torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None]))
    assert gradients[0].abs().max() > 0
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(gradients[2], gradients[0], rtol=1e-4, atol=1e-7)


def test_tensorboard_gets_the_log(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    journal = Journal(tmp_path, 0, tensorboard=True)
    journal.add({"step": 3, "loss": 0.25, "psnr": 20.0, "lr": 1e-3})
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("loss")] == [(3, 0.25)]


def test_targets_never_reach_the_reconstruction(tmp_path: Path) -> None:
    config = training(tmp_path / "cache")
    model, scene = starting_model(config), sample(1)
    other = replace(
        scene, targets=replace(scene.targets, images=1 - scene.targets.images), target_cameras=scene.cameras
    )
    with torch.no_grad():
        one, two = (next(decoded(model, each, anchored(each), "fp32")) for each in (scene, other))
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.sh, two.sh)


def test_bf16_stays_near_float32(tmp_path: Path) -> None:
    config = training(tmp_path / "cache")
    model, scene = starting_model(config), sample(0)
    torch.nn.init.normal_(model.geometry_decoder.blocks[0].mlp.fc2.weight, std=0.02)
    exact, half = (next(decoded(model, scene, anchored(scene), precision)) for precision in ("fp32", "bf16"))
    assert half.means.dtype == torch.float32
    assert (half.scales / exact.scales).log().abs().median() < 0.02
    assert not torch.equal(half.scales, exact.scales)


def test_bf16_is_for_the_model_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In bf16, SSIM's variances cancel, and projections are off by pixels."""
    config = training(tmp_path / "cache", optimiser=OptimiserSettings(precision="bf16"))
    model, scene, drawn = starting_model(config), sample(0), []

    def spied(*given, **settings):  # type: ignore[no-untyped-def]
        drawn.append(torch.is_autocast_enabled("cpu"))
        return render(*given, **settings)

    monkeypatch.setattr("querysplat_cli.training.step.render", spied)
    add_gradient(model, scene, anchored(scene), StepSettings(config, weights(0, config.losses)), torch.Generator())
    assert drawn == [False]


@pytest.mark.parametrize(("branches", "blocks"), [("two", 2), ("one", 2)])
def test_ablations_learn(tmp_path: Path, branches: str, blocks: int) -> None:
    model = replace(TINY, branches=branches, geometry_blocks=blocks, appearance_blocks=0)
    config = training(tmp_path / "cache", model=model, start="prior")
    run(config, tmp_path / "run")
    before, after = starting_model(config).state_dict(), load_file(tmp_path / "run" / STATE)
    assert not torch.equal(before["appearance_head.weight"], after["model.appearance_head.weight"])


def test_learned_queries_grow_from_stage_to_stage(tmp_path: Path) -> None:
    model = replace(TINY, queries="learned", anchor_features=0, gaussians_per_query=4, heads=2, width=32)
    stages = (StageSettings(steps=2, lr=1e-3, queries=8), StageSettings(steps=3, lr=1e-4, queries=20))
    config = training(tmp_path / "cache", model=model, stages=stages, start="scratch", save_every=1)
    run(config, tmp_path / "whole")
    assert load_model(tmp_path / "whole" / MODEL).config.query_count == 20
    for after in (1, 2, 3):
        stopped(config, tmp_path / f"parts{after}", after)
        run(config, tmp_path / f"parts{after}", resume=True)
        assert_same_weights(tmp_path / "whole", tmp_path / f"parts{after}")


def test_a_batch_of_several_samples_is_one_step(tmp_path: Path) -> None:
    """One process takes the samples of a batch in turn, and steps along their mean gradient."""
    config = training(tmp_path / "cache", stages=(StageSettings(steps=1, lr=1e-3),))
    config = replace(config, optimiser=replace(config.optimiser, batch=3, keep=1.0))
    report = run(config, tmp_path / "run")
    assert (report.batch, report.processes) == (3, 1)
    moment = load_file(tmp_path / "run" / STATE)["moments.appearance_head.bias.exp_avg"]
    samples, model = CachedSamples(config.data, config.seed), starting_model(config)
    for index in range(3):
        scene, _ = samples.get(Draw(0, index, config.stages[0].inputs))
        add_gradient(model, scene, anchored(scene), StepSettings(config, weights(0, config.losses)), torch.Generator())
    summed = model.appearance_head.bias.grad
    torch.testing.assert_close(moment / moment.norm(), summed / summed.norm(), rtol=1e-3, atol=1e-5)


def test_each_growth_has_noise_of_its_own(tmp_path: Path) -> None:
    """With the same noise, the copy of a query would lie on that query's earlier copy."""
    stages = tuple(StageSettings(steps=1, lr=0.0, queries=queries) for queries in (8, 16, 32))
    config = training(tmp_path / "cache", stages=stages)
    config = replace(config, model=replace(config.model, queries="learned", query_count=8))
    trainer = Trainer(config, tmp_path, Processes(), CPU, resume=False)
    trainer._enter(1)
    trainer._enter(2)
    queries = trainer.model.geometry_queries.detach().flatten(0, -2)
    assert len(queries) == 32
    assert torch.cdist(queries, queries).fill_diagonal_(1.0).min() > 1e-3


def test_processes_that_cannot_share_a_batch_are_refused(tmp_path: Path) -> None:
    config = training(tmp_path / "cache")
    config = replace(config, optimiser=replace(config.optimiser, batch=64))
    with pytest.raises(QuerySplatError, match="6 processes cannot share a batch of 64 samples"):
        Trainer(config, tmp_path, Processes(world=6), CPU, resume=False)
    assert [samples_in_turn(64, processes) for processes in (1, 8, 64)] == [64, 8, 1]


@pytest.mark.slow
def test_two_processes_resume_exactly(tmp_path: Path) -> None:
    config = training(tmp_path / "cache", stages=(StageSettings(steps=4, lr=1e-3),))
    config = replace(config, optimiser=replace(config.optimiser, batch=2))
    path = tmp_path / "train.toml"
    path.write_text(toml(config))
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", "0"]
    command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0"]
    command += ["-m", "querysplat_cli", "train", "--config", str(path), "--quiet", "--device", "cpu"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    for folder, more in ((whole, ()), (parts, ("--set", "stages.0.steps=4"))):
        if folder == parts:
            process = psutil.Popen([*command, "-o", str(folder), *more], env=environment)
            deadline = time.monotonic() + 120
            while not (folder / STATE).is_file() and time.monotonic() < deadline:
                time.sleep(0.01)
            for each in (process, *process.children(recursive=True)):  # torchrun's workers have sessions of their own
                each.kill()
            process.wait()
            more = (*more, "--resume")
        subprocess.run([*command, "-o", str(folder), *more], env=environment, check=True, capture_output=True)
    assert_same_weights(whole, parts)
    run(config, tmp_path / "alone")
    logs = [(folder / "log.jsonl").read_text().splitlines() for folder in (whole, tmp_path / "alone")]
    together, alone = ([json.loads(line)["loss"] for line in log] for log in logs)
    assert together == pytest.approx(alone, rel=1e-3), "the log is of the whole batch, not of the first process"


@pytest.mark.slow
def test_a_smoke_training_lowers_the_loss(tmp_path: Path) -> None:
    """A small model for a minute or two: the loss of its targets falls, on average over the scenes."""
    config = training(
        tmp_path / "cache",
        scenes=8,
        stages=(StageSettings(steps=800, lr=2e-3),),
        losses=LossSettings(lpips=0.0, visibility=0.0, chamfer=0.0, opacity_floor=0.0, background=0.0),
        optimiser=OptimiserSettings(precision="fp32", ema=0.9, weight_decay=0.0),
        save_every=400,
    )
    run(config, tmp_path / "run")
    rows = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    first, last = (sum(row["loss"] for row in part) / len(part) for part in (rows[:16], rows[-16:]))
    assert last < 0.85 * first
