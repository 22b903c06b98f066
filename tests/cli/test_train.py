"""`querysplat train`, run as a command."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from querysplat_cli.cli import run
from querysplat_cli.encoders.base import Encoder
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.training.config import DataSettings, StageSettings
from querysplat_cli.training.data import Wanted, sample_maker
from querysplat_cli.training.trainer import STATE
from training_scenes import toml, training


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "train.toml"
    path.write_text(toml(training(tmp_path / "cache", stages=(StageSettings(steps=2, lr=1e-3),))))
    return path


def test_train_resume_and_refuse(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", "--config", str(config), "-o", str(config.parent / "run"), "--json"]
    assert run(command) == ExitCode.DONE
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert (report["steps"], report["batch"], report["processes"]) == (2, 1, 1)
    assert report["steps_per_second"] > 0
    assert 0 <= report["waiting"] <= 1
    assert report["peak_memory_gib"] > 0.1
    assert "dB" in said.err
    assert Path(report["model"]).is_file()
    assert run(command) == ExitCode.BAD_INPUT
    assert "there already" in capsys.readouterr().err
    assert run([*command, "--resume"]) == ExitCode.DONE


def test_a_model_that_cannot_read_the_encoder_is_refused(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It ended in a traceback, as a bug."""
    command = ["train", "--config", str(config), "-o", str(config.parent / "run"), "--set", "model.vgm_width=16"]
    for more in ([], ["--dry-run"]):
        assert run([*command, *more]) == ExitCode.BAD_INPUT
        assert "layers of 12 channels, the model reads 1 of 16" in capsys.readouterr().err


def test_bad_input_is_refused_before_samples_are_made(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They may take hours."""

    def make(*_: object) -> None:
        raise AssertionError("samples are made")

    monkeypatch.setattr("querysplat_cli.training.run._samples", make)
    assert run(["train", "--config", str(config), "-o", str(config.parent / "none"), "--resume"]) == ExitCode.BAD_INPUT
    assert "no training to go on with" in capsys.readouterr().err


def test_samples_only_leaves_a_training_in_the_folder_alone(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was refused, although it replaces nothing."""
    state = config.parent / "run" / STATE
    state.parent.mkdir()
    state.write_text("of another training")
    command = ["train", "--config", str(config), "-o", str(state.parent), "--samples-only", "--json"]
    assert run(command) == ExitCode.DONE
    report = json.loads(capsys.readouterr().out)
    assert report["ready"] > 0
    assert report["failed"] == []
    assert state.read_text() == "of another training"


def test_a_replaced_training_cannot_be_resumed(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Until the first save its state was there, and --resume went on with it."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    state = config.parent / "run" / STATE
    state.parent.mkdir()
    state.write_text("of another training")
    monkeypatch.setattr("querysplat_cli.training.trainer.Trainer._step", stop)
    command = ["train", "--config", str(config), "-o", str(state.parent), "--force"]
    assert run([*command, "--set", "optimiser.batch=0"]) == ExitCode.BAD_INPUT
    assert state.is_file()
    assert run(command) == ExitCode.INTERRUPTED
    assert "--resume" not in capsys.readouterr().err
    assert not state.exists()


def test_dry_run_measures_and_writes_nothing(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert not (config.parent / "run").exists()
    assert plan["parameters"] > plan["samples"] == plan["ready"] == 3
    assert [stage["distinct"] for stage in plan["stages"]] == [2]
    assert 0 < plan["disk_gib"] < 0.01
    assert plan["seconds_per_step"] > 0
    assert plan["hours"] > 0
    assert plan["unmeasured"] == ""


def test_under_torchrun_the_first_process_alone_prints_the_plan(
    config: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Each printed one, so that standard output was no JSON."""
    monkeypatch.setenv("RANK", "1")
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    assert capfd.readouterr() == ("", "")


def test_dry_run_counts_the_samples_that_are_still_to_be_made(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Once one sample was cached, making the others took no time."""
    next((config.parent / "cache").rglob("*.safetensors")).unlink()
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert (plan["samples"], plan["ready"]) == (3, 2)
    assert plan["seconds_per_sample"] > 0
    assert plan["hours"] > plan["seconds_per_sample"] / 3600


def test_dry_run_does_not_count_what_is_compiled_once(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the first sample of a machine, two hours were expected of a training of half an hour."""
    pauses = iter([5.0, 0.0])

    def maker(setup: tuple[DataSettings, Callable[[], Encoder]]) -> Callable[[Wanted], None]:
        make = sample_maker(setup)

        def compiled(job: Wanted) -> None:
            time.sleep(next(pauses))
            make(job)

        return compiled

    next((config.parent / "cache").rglob("*.safetensors")).unlink()
    monkeypatch.setattr("querysplat_cli.training.plan.sample_maker", maker)
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["seconds_per_sample"] < 5


def test_dry_run_makes_one_sample_and_says_why_it_cannot(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It made a sample of every captured scene, and named a folder that was gone."""
    made = []

    def maker(_: object) -> Callable[[Wanted], None]:
        def make(job: Wanted) -> None:
            made.append(job)
            job.reason.parent.mkdir(parents=True)
            job.reason.write_text("too dark")

        return make

    next((config.parent / "cache").rglob("*.safetensors")).unlink()
    monkeypatch.setattr("querysplat_cli.training.plan.sample_maker", maker)
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    assert len(made) == 1
    assert "too dark" in json.loads(capsys.readouterr().out)["unmeasured"]


def test_dry_run_of_the_paper_states_batch_samples_disk_and_memory(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scenes and the encoder's weights need not be there."""
    command = ["train", "--config", "paper", "--dry-run", "--json"]
    assert run(command) == ExitCode.DONE
    said = capsys.readouterr()
    plan = json.loads(said.out)
    assert (plan["batch"], plan["processes"], plan["in_turn"]) == (64, 1, 64)
    assert plan["scenes"] == 10_510
    assert "DL3DV-10K" in plan["assumed"]
    assert [stage["drawn"] for stage in plan["stages"]] == [19_200_000, *[1_920_000] * 3]
    assert all(stage["distinct"] == stage["drawn"] for stage in plan["stages"])
    assert (plan["online"], plan["samples"], plan["disk_gib"]) == (True, 0, 0)
    assert plan["parameters"] == pytest.approx(1.118e9, rel=1e-3)
    assert plan["state_gib"] == pytest.approx(5 * 4 * plan["parameters"] / 2**30)
    for words in ("batch", "64 samples: 1 process × 64 in turn", "made in each step", "GiB in each process"):
        assert words in said.err
    monkeypatch.setenv("WORLD_SIZE", "32")
    assert run([*command, "--set", "data.online=false"]) == ExitCode.DONE
    said = capsys.readouterr()
    plan = json.loads(said.out)
    assert (plan["processes"], plan["in_turn"]) == (32, 2)
    assert [stage["distinct"] for stage in plan["stages"]] == [84_080] * 4
    assert plan["samples"] == 2 * 84_080
    # Four inputs of 80.8 MB in the base stage, and 138 MB with seven on the mean later: 6.8 and 11.6 TB.
    assert plan["disk_gib"] * 2**30 == pytest.approx(18.4e12, rel=0.01)
    assert "18.4 TB on disk" in said.err
    monkeypatch.setenv("WORLD_SIZE", "6")
    assert run(command) == ExitCode.BAD_INPUT
    assert "6 processes cannot share a batch of 64" in capsys.readouterr().err


def test_dry_run_reports_missing_encoder_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = f'data.sources.0.places=["{tmp_path}"]'
    (tmp_path / "images").mkdir()
    sizes = ["model.width=32", "model.heads=2", "model.vgm_width=32", "data.weights=nowhere"]
    changes = [part for change in (places, *sizes) for part in ("--set", change)]
    assert run(["train", "--config", "paper", *changes, "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["steps"] == 390_000
    assert "`querysplat weights`" in plan["unmeasured"]  # a way on, not the fault alone
    assert plan["hours"] is None


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--config", "nobody"], ExitCode.BAD_INPUT),
        (["--set", "unknown=1"], ExitCode.BAD_INPUT),
        (["--resume", "-o", "nowhere"], ExitCode.BAD_INPUT),
        (["--set", "losses.lpips=0.05", "--set", "losses.lpips_start=0"], ExitCode.MISSING_PART),
    ],
)
def test_errors_are_two_lines(
    config: Path,
    arguments: list[str],
    code: ExitCode,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(config.parent)
    given = ["--config", str(config)] if "--config" not in arguments else []
    assert run(["train", *given, *arguments, "--quiet"]) == code
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 2
    assert said[0].startswith("error: ")
    assert not Path("nowhere").exists()
