"""`querysplat train`, run as a command."""

import json
from pathlib import Path

import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.training.config import StageSettings
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
    assert report["steps"] == 2
    assert report["steps_per_second"] > 0
    assert 0 <= report["waiting"] <= 1
    assert report["peak_memory_gib"] > 0.1
    assert "dB" in said.err
    assert Path(report["model"]).is_file()
    assert run(command) == ExitCode.BAD_INPUT
    assert "there already" in capsys.readouterr().err
    assert run([*command, "--resume"]) == ExitCode.DONE


def test_dry_run_measures_and_writes_nothing(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["train", "--config", str(config), "-o", str(config.parent / "run"), "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert not (config.parent / "run").exists()
    assert plan["parameters"] > plan["samples"] == plan["ready"] == 3
    assert plan["seconds_per_step"] > 0
    assert plan["hours"] > 0
    assert plan["unmeasured"] == ""


def test_dry_run_of_the_papers_training_says_how_to_name_its_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The model of a thousand million numbers is not made first."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("querysplat_cli.training.run.starting_model", lambda config: pytest.fail("the model was made"))
    assert run(["train", "--config", "paper", "--dry-run"]) == ExitCode.BAD_INPUT
    message, hint = capsys.readouterr().err.splitlines()[-2:]
    assert message == "error: DL3DV-10K: no such folder of scenes to train on"
    assert hint.strip() == """Name your own with --set 'data.sources.0.places=["/path/to/scenes"]'."""


def test_dry_run_reports_missing_encoder_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = f'data.sources.0.places=["{tmp_path}"]'
    (tmp_path / "images").mkdir()
    sizes = ["model.width=32", "model.heads=2", "model.vgm_width=32", "data.weights=nowhere"]
    changes = [part for change in (places, *sizes) for part in ("--set", change)]
    assert run(["train", "--config", "paper", *changes, "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["steps"] == 390_000
    assert plan["unmeasured"]
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
