"""`querysplat eval` on a procedural scene in DL3DV's form, run as a command."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
from evaluation_scenes import write_room

from lpips_weights import write_weights as write_lpips_weights
from tiny_weights import write_weights

FRAMES = 20
OPTIONS = ["--views", "4", "--scales", "small", "--cases", "1", "--tto", "0,12", "--quiet"]
ROWS = {f"{cameras}_{row}" for cameras in ("free", "posed") for row in ("depth", "tto=0", "tto=12")}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("data") / "rooms" / "room1"
    write_room(home, FRAMES)
    return home.parent


@pytest.fixture(scope="module")
def evaluated(room: Path) -> tuple[Path, dict[str, Any]]:
    out = room.parent / "out"
    command = [sys.executable, "-m", "querysplat_cli", "eval", str(room), "-o", str(out), "--json", *OPTIONS]
    kept = ["--save-pictures", "--nerfbaselines"]
    done = subprocess.run([*command, *kept], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return out, json.loads(done.stdout)


def files(out: Path) -> dict[str, int]:
    """When each case that is done was written."""
    done = out.glob("*/*/[!.]*/metrics.json")
    return {str(path.relative_to(out)): path.stat().st_mtime_ns for path in done}


def test_every_row_has_every_view(evaluated: tuple[Path, dict[str, Any]]) -> None:
    out, summary = evaluated
    assert summary == json.loads((out / "summary.json").read_text())
    assert {row["row"] for row in summary["rows"]} == ROWS
    assert summary["failures"] == []
    for row in summary["rows"]:
        assert (row["scored"], row["asked"], row["cases"]) == (4, 4, 1), row
    psnr = {(row["row"], row["group"]): row["psnr"] for row in summary["averages"]}
    for cameras in ("free", "posed"):
        # More steps fit the inputs better; what was not shown is harder, and the cameras of it are right.
        assert psnr[f"{cameras}_tto=12", "input"] > psnr[f"{cameras}_tto=0", "input"] + 0.5
        assert psnr[f"{cameras}_tto=12", "input"] > psnr[f"{cameras}_tto=12", "interp"] > 19
        assert psnr[f"{cameras}_tto=12", "extrap"] > 14
    case = out / "posed_tto=12" / "4views_small" / "room1_000"
    assert {path.name for path in case.iterdir()} == {
        "metrics.json",
        "timing.json",
        "cameras.npz",
        "rendered",
        "nerfbaselines",
    }
    config = json.loads((case.parent / "run_config.json").read_text())
    assert len(config["settings"]["checkpoint_sha256"]) == 64
    assert json.loads((out / "splits" / "4views_small.json").read_text())["total_samples"] == 1
    timing = json.loads((case / "timing.json").read_text())
    assert {"cameras", "depth", "queries", "tto", "total"} == timing["seconds"].keys()
    assert 0.1 < timing["peak_memory_gib"] < 4


def test_every_case_is_kept_in_nerfbaselines_layout(evaluated: tuple[Path, dict[str, Any]]) -> None:
    """As docs/evaluation.md says: info.json, color/ and gt-color/, with the scores of the rounded pictures."""
    out, _ = evaluated
    cases = [(out / name).parent for name in files(out)]
    assert len(cases) == len(ROWS)
    for case in cases:
        folder = case / "nerfbaselines"
        assert {path.name for path in folder.iterdir()} == {"info.json", "color", "gt-color"}
        renders, photos, rendered = (
            {path.relative_to(place): path for path in place.rglob("*.png")}
            for place in (folder / "color", folder / "gt-color", case / "rendered")
        )
        assert renders.keys() == photos.keys() == rendered.keys()
        scores = json.loads((folder / "info.json").read_text())["querysplat"]["scores"]
        frames = json.loads((case / "metrics.json").read_text())["frames"]
        names = {f"{group}/{view['name']}" for group, views in frames.items() for view in views}
        assert {str(name) for name in renders} == scores.keys() == names
        assert len(names) == 12
        for name, file in renders.items():
            assert file.read_bytes() == rendered[name].read_bytes()
            psnr = cv2.PSNR(cv2.imread(str(file)), cv2.imread(str(photos[name])))
            assert scores[str(name)]["psnr"] == pytest.approx(psnr, abs=1e-3)


def test_a_second_run_does_only_what_is_missing(evaluated: tuple[Path, dict[str, Any]], room: Path) -> None:
    out, summary = evaluated
    before = files(out)
    gone = "posed_depth/4views_small/room1_000"
    shutil.rmtree(out / gone)
    assert run(["eval", str(room), "-o", str(out), *OPTIONS, "--save-pictures"]) == 0
    after = files(out)
    assert after.keys() == before.keys()
    assert [name for name in after if after[name] != before[name]] == [f"{gone}/metrics.json"]
    again = json.loads((out / "summary.json").read_text())
    assert [row["psnr"] for row in again["rows"]] == [row["psnr"] for row in summary["rows"]]


def test_other_settings_are_refused(
    evaluated: tuple[Path, dict[str, Any]], room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, _ = evaluated
    before = files(out)
    assert run(["eval", str(room), "-o", str(out), *OPTIONS, "--seed", "7"]) == ExitCode.BAD_INPUT
    assert "other settings" in capsys.readouterr().err
    assert files(out) == before


def test_our_renders_score_the_same_as_predictions(evaluated: tuple[Path, dict[str, Any]], room: Path) -> None:
    """Our own renders, scored by --predictions. One split file names a scene that is missing."""
    out, summary = evaluated
    splits = room.parent / "splits"
    shutil.copytree(out / "splits", splits)
    content = json.loads((splits / "4views_small.json").read_text())
    content["samples"].append({**content["samples"][0], "scene_id": "elsewhere"})
    (splits / "4views_small.json").write_text(json.dumps(content))
    theirs = room.parent / "theirs"
    arguments = ["eval", str(room), "-o", str(theirs), "--splits", str(splits), "--name", "rival", "-q"]
    assert run([*arguments, "--predictions", str(out / "free_tto=12")]) == 0
    found = json.loads((theirs / "summary.json").read_text())
    assert [(failure["case"], failure["row"]) for failure in found["failures"]] == [("elsewhere_001", "rival")]
    ours = {row["group"]: row["psnr"] for row in summary["rows"] if row["row"] == "free_tto=12"}
    assert {row["group"]: row["psnr"] for row in found["rows"]} == pytest.approx(ours, abs=0.02)  # 8-bit pictures


@pytest.mark.parametrize("protocol", [pytest.param("release", marks=pytest.mark.slow), "text"])
def test_an_encoder_that_looks_at_squares_is_shown_whole_photos(
    protocol: str, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A network with tiny random weights. It estimates the inputs' cameras itself, also in the posed rows."""
    weights = ["--preset", "official-8192", "--weights", str(write_weights(tmp_path / "weights"))]
    size = ["--max-size", "112", "--protocol", protocol, "--tto", "0", "--json"]
    options = ["--views", "2", "--scales", "small", "--cases", "1", "--quiet"]
    assert run(["eval", str(room), "-o", str(tmp_path / "out"), *options, *weights, *size]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["failures"] == []
    assert {row["row"] for row in summary["rows"]} == {"free_depth", "free_tto=0", "posed_depth", "posed_tto=0"}
    for row in summary["rows"]:
        assert row["scored"] == row["asked"] > 0, row
        assert row["psnr"] > 0


@pytest.mark.slow
def test_official_models_are_optimised_with_lpips_where_its_weights_are(room: Path, tmp_path: Path) -> None:
    """The release's loss has it. Results with and without it do not mix."""
    write_lpips_weights(tmp_path / "lpips", "vgg")
    weights = ["--preset", "official-8192", "--weights", str(write_weights(tmp_path / "weights"))]
    options = ["--views", "2", "--scales", "small", "--cases", "1", "--cameras", "posed", "--tto", "1", "--quiet"]
    command = ["eval", str(room), "-o", str(tmp_path / "out"), "--max-size", "112", *options, *weights]
    assert run([*command, "--lpips", str(tmp_path / "lpips")]) == 0
    config = json.loads((tmp_path / "out/posed_tto=1/2views_small/run_config.json").read_text())
    assert config["settings"]["lpips"] is True
    assert run(command) == 2
    shutil.move(tmp_path / "out", tmp_path / "with")
    assert run(command) == 0
    scores = [json.loads((tmp_path / out / "summary.json").read_text())["rows"] for out in ("with", "out")]
    optimised = [[row["psnr"] for row in rows if row["row"] == "posed_tto=1"] for rows in scores]
    assert optimised[0] != optimised[1]


@pytest.mark.slow
def test_cases_on_a_cluster_score_the_same(evaluated: tuple[Path, dict[str, Any]], room: Path, tmp_path: Path) -> None:
    """Dask's workers make the scenes that one process made before."""
    pytest.importorskip("distributed")
    options = [*OPTIONS, "--cameras", "posed", "--tto", "0", "--cluster", "local:2"]
    command = [sys.executable, "-m", "querysplat_cli", "eval", str(room), "-o", str(tmp_path / "out"), "--json"]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["failures"] == []
    before = {(row["row"], row["group"]): row["psnr"] for row in evaluated[1]["rows"]}
    after = {(row["row"], row["group"]): row["psnr"] for row in found["rows"]}
    assert {row for row, _ in after} == {"posed_depth", "posed_tto=0"}
    assert after == pytest.approx({key: before[key] for key in after}, abs=1e-3)


def test_the_cameras_of_a_set_are_compared_with_colmaps(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """COLMAP sees the photos under other names, in a folder of its own."""
    assert run(["poses", str(room / "room1"), "--colmap", "--json", "-q"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["photos"] > FRAMES // 2
    assert found["ate_of_extent"] < 0.02


@pytest.mark.slow
def test_shards_make_the_whole(room: Path) -> None:
    options = [*OPTIONS, "--cameras", "posed", "--cases", "2", "--workers", "2"]
    assert run(["eval", str(room), "-o", str(room.parent / "whole"), *options]) == 0
    summary = json.loads((room.parent / "whole" / "summary.json").read_text())
    parts = [room.parent / f"shard{i}" for i in (1, 2)]
    for i, part in enumerate(parts, start=1):
        assert run(["eval", str(room), "-o", str(part), *options, "--shard", f"{i}/2"]) == 0
        assert len(files(part)) == 3
    merged = room.parent / "merged"
    assert run(["eval", *map(str, parts), "--merge", "-o", str(merged), "-q"]) == 0
    found = json.loads((merged / "summary.json").read_text())
    whole = {(row["row"], row["group"]): row["psnr"] for row in summary["rows"]}
    assert {(row["row"], row["group"]): row["psnr"] for row in found["rows"]} == pytest.approx(whole, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kill", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_run_leaves_whole_cases_and_goes_on(kill: signal.Signals, room: Path, tmp_path: Path) -> None:
    """A cluster's scheduler stops a job by SIGTERM, and kills it when that does not help."""
    out, whole = tmp_path / "out", tmp_path / "whole"
    options = [*OPTIONS, "--cameras", "posed", "--cases", "4"]
    command = [sys.executable, "-m", "querysplat_cli", "eval", str(room), "-o", str(out), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        limit = time.monotonic() + 300  # the machine may be busy
        while not files(out) and time.monotonic() < limit:
            time.sleep(0.01)
        os.killpg(process.pid, kill) if kill == signal.SIGKILL else process.send_signal(kill)
        said = process.communicate(timeout=60)[1]
    before = files(out)
    assert 0 < len(before) < 3 * 4
    assert "Traceback" not in said
    if kill == signal.SIGTERM:
        assert process.returncode == 128 + kill
        assert "Aborted" not in said
        assert f"Finished cases are in {out}, and the same command goes on with the others." in said
        assert not list(out.rglob(".*"))
    assert run(["eval", str(room), "-o", str(out), *options]) == ExitCode.DONE
    assert not list(out.rglob(".*"))
    assert {name: files(out)[name] for name in before} == before
    assert run(["eval", str(room), "-o", str(whole), *options]) == ExitCode.DONE
    found, expected = (json.loads((folder / "summary.json").read_text()) for folder in (out, whole))
    assert found["failures"] == []
    assert [row["psnr"] for row in found["rows"]] == [row["psnr"] for row in expected["rows"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere"),
        (["ROOM", "--views", "3"], "'--views': '3' is not one of 2, 4, 12"),
        (["ROOM", "--scales", "huge"], "'--scales': 'huge' is not one of"),
        (["ROOM", "--shard", "3/2"], "--shard '3/2'"),
        (["ROOM", "--sweep", "colour=1"], "--sweep 'colour=1'"),
        (["ROOM", "--views", "12", "--scales", "large"], "no scene has the 49 frames"),
        (["ROOM", "--splits", "nowhere.json"], "nowhere.json"),
        (["ROOM", "--predictions", "nowhere"], "nowhere"),
        (["ROOM", "--predictions", "/tmp", "--name", "../up"], "--name ../up"),
    ],
)
def test_bad_requests(
    arguments: list[str], message: str, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(room) if part == "ROOM" else part for part in arguments]
    code = run(["eval", *given, "-o", str(tmp_path / "out"), "--quiet", "--cases", "1"])
    assert code == (ExitCode.IMPOSSIBLE if "49" in message else ExitCode.BAD_INPUT)
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("error: ") == 1
    assert not (tmp_path / "out").exists()
