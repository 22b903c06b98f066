"""`querysplat doctor` on this machine, and on machines that lack something."""

import json
import signal
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from querysplat_cli.cli import run
from querysplat_cli.commands import doctor
from querysplat_cli.runtime import containers, signals
from querysplat_cli.runtime.optional_parts import OPTIONAL_PARTS


def diagnosed(capsys: pytest.CaptureFixture[str], code: int = 0) -> dict[str, Any]:
    assert run(["doctor", "--json", "--quiet"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_a_working_machine_has_no_problems(capsys: pytest.CaptureFixture[str]) -> None:
    found = diagnosed(capsys)
    assert found["problems"] == []
    assert "cpu" in found["devices"]
    assert 0 <= found["compiled"] <= found["kernels"]
    assert found["kernels"] > 10
    assert 0 < found["free_memory_gib"] <= found["memory_gib"]
    assert [part["extra"] for part in found["optional"]] == [part.extra for part in OPTIONAL_PARTS]
    parts = {part["extra"]: part for part in found["optional"]}
    assert parts["formats"]["version"]  # the tests install it
    assert parts["formats"]["command"] == "pip install 'querysplat[formats]'"


def test_cores_are_those_that_the_container_allows(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(containers, "cores", lambda: 1)
    assert ", 1 core, " in diagnosed(capsys)["machine"]


def test_a_part_that_is_missing_is_no_problem(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    assert run(["doctor"]) == 0
    text = " ".join(capsys.readouterr().err.split())
    assert "not here. pip install 'querysplat[heic]' brings HEIC photos" in text


def test_a_module_that_does_not_load_is_named_with_the_command_that_mends_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(name: str) -> object:
        if name == "cv2":
            raise OSError("libGL.so.1: cannot open shared object file\nmore")
        return import_module(name)

    monkeypatch.setattr(doctor, "import_module", load)
    (problem,) = diagnosed(capsys, 4)["problems"]
    assert problem.startswith("cv2 cannot be loaded: libGL.so.1: cannot open shared object file. Run `pip install")
    assert "opencv-contrib-python-headless" in problem


def test_a_module_whose_import_is_interrupted_is_not_called_broken(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """pycolmap, interrupted while it is imported, raises an ImportError without words."""

    def interrupted() -> None:
        with suppress(KeyboardInterrupt):
            signals.interrupt(signal.SIGINT)
        raise ImportError

    monkeypatch.setattr(doctor, "load_pycolmap", interrupted)
    monkeypatch.setattr(signals._State, "received", None)
    assert run(["doctor"]) == 130
    shown = capsys.readouterr().err
    assert "stopped" in shown
    assert "pycolmap" not in shown


def test_too_little_memory_and_disk_are_problems(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "free_memory", lambda: 2**29)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: SimpleNamespace(free=2**20))
    memory, disk = diagnosed(capsys, 4)["problems"]
    assert "0.5 GiB of memory are free" in memory
    assert "TMPDIR" in disk


def test_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["doctor", "--quiet"]) == 0
    assert list(tmp_path.iterdir()) == []


def test_an_untested_python_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TESTED_PYTHON", ("3.9", "3.10"))
    assert not doctor.tested_python()
    monkeypatch.setattr(doctor, "TESTED_PYTHON", ("3.9", f"3.{sys.version_info.minor}"))
    assert doctor.tested_python()
