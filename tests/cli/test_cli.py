"""The command line from outside: its messages and exit codes."""

import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.errors import ExitCode, ImpossibleScene, MissingPart


def one_error(capsys: pytest.CaptureFixture[str]) -> str:
    """The message on standard error: one line, and nothing that looks like a traceback."""
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    assert captured.out == ""
    return lines[0]


def photo(path: Path, seed: int = 0) -> Path:
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 255, (96, 128, 3), dtype=np.uint8))
    return path


def test_a_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["reconstruct", str(tmp_path / "nowhere"), "-o", str(tmp_path / "a.ply")]) == ExitCode.BAD_INPUT
    assert "nowhere" in one_error(capsys)


def test_an_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert run(["reconstruct", str(empty), "-o", str(tmp_path / "a.ply"), "-q"]) == ExitCode.BAD_INPUT
    assert "empty folder" in one_error(capsys)


def test_nothing_is_overwritten_without_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_text("mine")
    picture = photo(tmp_path / "p.png")
    assert run(["reconstruct", str(picture), "-o", str(tmp_path / "a.ply"), "-q"]) == ExitCode.BAD_INPUT
    assert "there already" in one_error(capsys)
    assert (tmp_path / "a.ply").read_text() == "mine"


def test_files_that_are_no_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.jpg").write_bytes(b"not a picture")
    (tmp_path / "b.jpg").write_bytes(b"")
    assert run(["reconstruct", str(tmp_path), "-o", str(tmp_path / "s.ply"), "-q"]) == ExitCode.BAD_INPUT
    message = one_error(capsys)
    assert "a.jpg" in message
    assert "b.jpg" in message


@pytest.mark.parametrize("arguments", [["--tto", "-3"], ["--tto", "many"], ["--queries", "0"], ["--nonsense"]])
def test_bad_options(arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["reconstruct", str(photo(tmp_path / "p.png")), *arguments]) == ExitCode.BAD_INPUT
    one_error(capsys)


@pytest.mark.parametrize("arguments", [["a" * 300], ["info", f"--{'a' * 300}/b"]])
def test_a_word_that_is_too_long_for_a_file(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Words are looked up among files, to say what was meant."""
    assert run(arguments) == ExitCode.BAD_INPUT
    one_error(capsys)


def test_an_unknown_preset_and_encoder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = str(photo(tmp_path / "p.png"))
    for option in ("--preset", "--encoder"):
        assert run(["reconstruct", picture, "-o", str(tmp_path / "s.ply"), "-q", option, "magic"]) == ExitCode.BAD_INPUT
        assert "magic" in one_error(capsys)


def test_official_weights_are_named_as_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = str(photo(tmp_path / "p.png"))
    arguments = ["reconstruct", picture, "-o", str(tmp_path / "s.ply"), "-q", "--preset", "official-paper"]
    assert run(arguments) == ExitCode.MISSING_PART
    assert "weights" in one_error(capsys)


@pytest.mark.parametrize("verb", ["tto", "render"])
def test_a_path_that_is_no_scene(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([verb, str(tmp_path / "nothing")]) == ExitCode.BAD_INPUT
    assert "nothing" in one_error(capsys)


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (ImpossibleScene("no overlap"), ExitCode.IMPOSSIBLE),
        (MissingPart("no weights"), ExitCode.MISSING_PART),
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
        (OSError(28, "No space left on device"), ExitCode.BAD_INPUT),
    ],
)
def test_exit_codes(
    raised: BaseException,
    code: ExitCode,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise raised

    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.load_inputs", fail)
    assert run(["reconstruct", str(photo(tmp_path / "p.png")), "-o", str(tmp_path / "s.ply"), "-q"]) == code
    one_error(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]


def test_a_bug_keeps_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.load_inputs", lambda *a, **k: 1 / 0)
    assert run(["reconstruct", str(photo(tmp_path / "p.png")), "-o", str(tmp_path / "s.ply"), "-q"]) == ExitCode.BUG
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_ctrl_c_inside_exec_keeps_the_exit_code(tmp_path: Path) -> None:
    """CPython reports an interruption as unhandled when it was raised inside exec(), even after it was caught."""
    (tmp_path / "interrupted.py").write_text("""
from querysplat_cli import cli

def interrupted(*_, **__):
    exec("raise KeyboardInterrupt")

cli.app = interrupted
cli.main()
""")
    command = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False, text=True)
    assert done.returncode == ExitCode.INTERRUPTED, done.stderr
    assert "stopped" in done.stderr


NINES = "9" * 5000


@pytest.mark.parametrize(
    ("verb", "options"),
    [
        *(
            ("reconstruct", (option, number))
            for option in ("--tto", "--queries", "--max-size", "--max-views", "--holdout-every", "--seed", "--prune")
            for number in (NINES, "99999999999999999999", "1e30", "nan")
        ),
        *(("reconstruct", ("--budget", number)) for number in (NINES, "inf", "nan", "1e300", "-1")),
        ("reconstruct", ("--seed", "-1")),
        *(("render", ("--size", size)) for size in (f"{NINES}x{NINES}", "0x0", "99999999x2", "x", "1e3x1e3")),
        *(("render", ("--frames", number)) for number in (NINES, "0", "2000000000")),
        *(("render", ("--fps", number)) for number in (NINES, "0", "100000")),
        *(("render", ("--background", colour)) for colour in ("nan,0,0", f"{NINES},0,0", "2,0,0")),
        *(("convert", ("--scale", number)) for number in (NINES, "inf", "nan", "1e300", "1e-300", "0", "-1")),
        *(("convert", ("--crop", box)) for box in ("nan,0,0,1,1,1", NINES, "1,1,1,0,0,0")),
        ("demo", ("--photos", NINES)),
        ("demo", ("--photos", "1000000000")),
        ("eval", ("--shard", f"1/{NINES}")),
        ("inspect", ("--query", NINES)),
        ("tto", ("--lr", "inf")),
        ("tto", ("--steps", "9" * 30)),
    ],
)
def test_extreme_numbers_are_refused_in_one_short_line(
    verb: str, options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"convert": [str(tmp_path / "a.ply"), str(tmp_path / "b.ply")], "demo": ["-o", str(tmp_path / "d")]}
    assert run([verb, *places.get(verb, [str(tmp_path / "a.ply")]), *options]) == ExitCode.BAD_INPUT
    message = one_error(capsys)
    assert options[0] in message or options[0] in message.lower()
    assert len(message) < 400
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (".", "not a kind of file"),
        ("/", "not a kind of file"),
        ("..", "not a kind of file"),
        ("c3", "not a kind of file"),
        ("c1.obj", "not a kind of file"),
        ("c.compressed.ply", ".compressed.ply"),
        ("folder.ply", "a folder has that name"),
        ("photos.ply", "which is read"),
        ("notes.ply", "did not write, as diary.txt"),
    ],
)
def test_outputs_that_cannot_be_written_are_refused_before_any_work(
    name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.load_inputs", lambda *a, **k: pytest.fail("work began"))
    for folder in ("photos", "folder.ply", "notes"):
        (tmp_path / folder).mkdir()
    picture = photo(tmp_path / "photos" / "p.png")
    (tmp_path / "notes" / "diary.txt").write_text("mine")
    monkeypatch.chdir(tmp_path / "folder.ply")
    output = name if name in (".", "/", "..") else str(tmp_path / name)
    assert run(["reconstruct", str(picture.parent), "-o", output, "--force", "-q"]) == ExitCode.BAD_INPUT
    assert message in one_error(capsys)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["diary.txt", "folder.ply", "notes", "p.png", "photos"]


def test_a_low_limit_of_the_address_space_is_named_before_any_work(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(photo(tmp_path / "p.png"))]
    limited = ["bash", "-c", 'ulimit -v 1500000; exec "$@"', "bash", *command, "-o", str(tmp_path / "s.ply")]
    done = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.MISSING_PART, done.stderr
    assert "1.4 GiB, and about" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]


@pytest.mark.parametrize(
    "raised",
    [
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4000000000000 bytes."),
        cv2.error("OpenCV(5.0) (-4:Insufficient memory) Failed to allocate 9 bytes"),
    ],
)
def test_too_little_memory_is_a_missing_part(
    raised: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise raised

    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.load_inputs", fail)
    picture = photo(tmp_path / "p.png")
    assert run(["reconstruct", str(picture), "-o", str(tmp_path / "s.ply"), "-q"]) == ExitCode.MISSING_PART
    assert "out of memory" in one_error(capsys)


def test_a_current_folder_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert run(["weights"]) == ExitCode.BAD_INPUT
    assert "the current folder was removed" in one_error(capsys)


@pytest.mark.parametrize(
    "error", [ImportError("cannot import name"), OSError("a library"), MissingPart("cannot be loaded", "Update it.")]
)
def test_an_error_that_an_interruption_became_is_no_bug(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """numpy, interrupted while it is imported, raises an ImportError."""

    def interrupted(*arguments: object, **options: object) -> None:
        with suppress(KeyboardInterrupt):
            signals.interrupt(signal.SIGTERM)
        raise error

    monkeypatch.setattr("querysplat_cli.pipeline.reconstruct.load_inputs", interrupted)
    monkeypatch.setattr(signals._State, "received", None)
    assert run(["reconstruct", str(photo(tmp_path / "p.png")), "-o", str(tmp_path / "s.ply"), "-q"]) == 143
    assert "stopped" in one_error(capsys)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named_where_output_goes() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "querysplat_cli", "doctor", "--json"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == ExitCode.BAD_INPUT
    assert "error: standard output: the disk is full" in done.stderr
