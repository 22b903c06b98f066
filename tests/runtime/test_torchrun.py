"""Errors of several processes of one training: each is told once."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed

from querysplat_cli.cli import run
from querysplat_cli.runtime import torchrun
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.training.processes import joined_processes

TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "querysplat_cli"]


@pytest.fixture
def second(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """This is the second process of its machine."""
    for name, value in {"TORCHELASTIC_RUN_ID": "one", "RANK": "1", "LOCAL_RANK": "1", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    for name in ("waited", "ended"):
        monkeypatch.setattr(torchrun._State, name, False)
    return monkeypatch


def end(seconds: float) -> None:
    """In place of sleep: torchrun's SIGTERM arrives."""
    raise KeyboardInterrupt


@pytest.mark.parametrize("ended", [True, False])
def test_the_second_process_tells_only_what_the_first_one_does_not(
    second: pytest.MonkeyPatch, ended: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every process printed the same error."""
    second.setattr("time.sleep", end if ended else lambda seconds: None)
    assert run(["train", "--config", "nowhere.toml"]) == ExitCode.BAD_INPUT
    assert ("nowhere.toml" in capsys.readouterr().err) != ended


def test_a_process_waits_before_it_parts_from_the_others(second: pytest.MonkeyPatch) -> None:
    """Else the first one takes the parting for its own error, and torchrun ends the second one before it has told."""
    happened: list[str] = []
    second.setattr("time.sleep", lambda seconds: happened.append("waits"))
    second.setattr(distributed, "init_process_group", lambda *_, **__: None)
    second.setattr(distributed, "get_rank", lambda: 1)
    second.setattr(distributed, "destroy_process_group", lambda: happened.append("parts"))
    with pytest.raises(QuerySplatError), joined_processes(torch.device("cpu")):
        raise QuerySplatError("its own")
    assert not torchrun.first_tells()
    assert happened == ["waits", "parts"]


@pytest.mark.slow
def test_two_processes_print_one_error(tmp_path: Path) -> None:
    command = [
        sys.executable,
        *TORCHRUN,
        "train",
        "--samples-only",
        "--config",
        "small",
        "--device",
        "cpu",
        "-o",
        str(tmp_path / "out"),
    ]
    changes = [f'data.sources.0.places=["{tmp_path / "nowhere"}"]', 'data.sources.0.kind="captured"']
    for change in changes:
        command += ["--set", change]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode
    assert done.stderr.count("error: ") == 1, done.stderr
    assert "no such folder of scenes" in done.stderr
