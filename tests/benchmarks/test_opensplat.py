"""OpenSplat beside our settings, with an executable of its name that stands in for it."""

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import fullscreen
import pareto
from common import opensplat
from common.photo_sets import PHOTO_SETS
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.scene_folder import StoredScene, write_scene
from querysplat_cli.reporting.report import Report
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.pictures import write_picture
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import PhotoSource, Views
from querysplat_cli.splat.transform import transform_gaussians

HEIGHT, WIDTH, LARGER = 24, 36, 4
"""The size of a working picture in pixels, and how many times larger the photos are."""
INPUTS, HELD_OUT = ("a.png", "one/b.png", "two/b.png"), ("d.png",)
GREY = 128
"""Of all photos, of 255."""
FRAME = Sim3(2.0, torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), torch.ones(3).double())
"""Files of the scene are in another frame than the one in which it was made."""
STAND_IN = """#!{python}
import json, pathlib, shutil, sys
import pycolmap
project, here = pathlib.Path(sys.argv[1]), pathlib.Path(__file__).parent
model = pycolmap.Reconstruction(project / "sparse" / "0")
photos = [file for file in (project / "images").rglob("*") if file.is_file()]
seen = {{
    "arguments": sys.argv[2:-1],
    "model": sorted(image.name for image in model.images.values()),
    "photos": sorted(file.relative_to(project / "images").as_posix() for file in photos),
    "points": len(model.points3D),
}}
(here / "seen.json").write_text(json.dumps(seen))
if not (here / "peer.ply").is_file():
    sys.exit("no room left")
shutil.copy(here / "peer.ply", sys.argv[-1])
pathlib.Path(sys.argv[-1]).with_name("cameras.json").write_text("[]")
"""


def views_of(names: tuple[str, ...], first: int) -> tuple[Views, Cameras]:
    """Grey pictures, from cameras side by side."""
    count = len(names)
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = -0.1 * (first + torch.arange(count))
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]).repeat(count, 1, 1)
    masks = torch.ones(count, HEIGHT, WIDTH, dtype=torch.bool)
    views = Views(torch.full((count, 3, HEIGHT, WIDTH), GREY / 255), masks, names, ((HEIGHT, WIDTH),) * count)
    return views, Cameras(w2c, K, HEIGHT, WIDTH)


def some_gaussians(count: int) -> Gaussians:
    """White ones, in front of all cameras."""
    means = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.3, -0.5, 2.0])
    turned, sizes = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count, 3), 0.1)
    return Gaussians(means, turned, sizes, torch.full((count,), 0.9), torch.full((count, 1, 3), 1.7))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder in which fox has our default scene, of three input photos and one that is held out."""
    lens = PhotoCamera(np.eye(4), (40.0, 40.0), (18.0, 12.0), (0.0, 0.0, 0.0, 0.0), HEIGHT, WIDTH)
    photos = {}
    for name in (*INPUTS, *HELD_OUT):
        write_picture(tmp_path / "photos" / name, np.full((LARGER * HEIGHT, LARGER * WIDTH, 3), GREY, np.uint8))
        photos[name] = PhotoFile.of(name, PhotoSource(tmp_path / "photos" / name), lens)
    nothing = Memories(*(torch.zeros(0, 2, 3) for _ in range(4)))
    held = views_of(HELD_OUT, 3)
    scene = StoredScene(*views_of(INPUTS, 0), held, nothing, None, "compact", photos=photos, frame=FRAME)
    report = Report(
        ply="s.ply", scene="s", views={"used": list(INPUTS), "left_out": []}, gaussians=9, seconds={"total": 1.0},
        quality={}, left_out=[], warnings=[], tto=[], settings={"queries": None, "weights": None, "precision": "fp32"},
        peak_memory_gib=0.5, machine="a machine",
    )  # fmt: skip
    (tmp_path / "scenes").mkdir()
    ply = fullscreen.scene_file(PHOTO_SETS["fox"], pareto.DEFAULT, tmp_path / "scenes")
    write_scene(ply, scene, some_gaussians(9), report.as_dict())
    return tmp_path / "scenes"


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder, first on the path, of an `opensplat` that writes what it was given, and a .ply of five Gaussians."""
    place = tmp_path / "bin"
    place.mkdir()
    script = place / "opensplat"
    script.write_text(STAND_IN.format(python=sys.executable))
    script.chmod(0o755)
    write_ply(place / "peer.ply", transform_gaussians(some_gaussians(5), FRAME))
    monkeypatch.setenv("PATH", f"{place}{os.pathsep}{os.environ['PATH']}")
    return place


def test_it_is_trained_without_held_out_photos_and_scored_on_them(
    folder: Path, stand_in: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rows = [{"set": "fox", "quality": pareto.DEFAULT}]
    options = argparse.Namespace(settings=[pareto.DEFAULT], sets=["fox"], data=tmp_path, keep=folder)
    options.json = tmp_path / "rows.json"
    pareto.measure(options, rows)
    seen = json.loads((stand_in / "seen.json").read_text())
    assert seen["model"] == seen["photos"] == sorted(INPUTS)
    assert seen["arguments"] == ["--cpu", "--keep-crs", "-n", "2000", "-o"]
    assert seen["points"] > 0
    row = json.loads(options.json.read_text())["rows"][1]
    assert (row["set"], row["quality"], row["gaussians"]) == ("fox", "OpenSplat, 2000 steps", 5)
    assert (row["working"]["size"], row["full"]["size"]) == (WIDTH, LARGER * WIDTH)
    # Grey photos: behind the Gaussians, which are in the frame of the scene's own, grey is right and black is wrong.
    held = views_of(HELD_OUT, 3)
    assert row["working"] == pytest.approx(vars(fullscreen.scored(some_gaussians(5), held)), abs=0.01)
    assert row["full"]["grey"] > row["full"]["black"] + 1
    assert row["cpu_seconds"] > 0
    assert row["seconds"] > 0
    assert row["gib"] > 0
    assert not list(folder.glob("cameras.json"))
    assert "| fox | tuned on | OpenSplat, 2000 steps |" in capsys.readouterr().out


def test_a_run_that_fails_has_no_row(folder: Path, stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (stand_in / "peer.ply").unlink()
    assert pareto.peer(PHOTO_SETS["fox"], folder, folder) is None
    assert "opensplat ended with code 1: no room left" in capsys.readouterr().err


def test_without_the_program_a_line_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(opensplat, "is_there", lambda: False)
    assert pareto.with_peer(["default", "20 steps"]) == ["default", "20 steps"]
    assert capsys.readouterr().err == "opensplat is not on the path, so it has no row\n"
    monkeypatch.setattr(opensplat, "is_there", lambda: True)
    assert pareto.with_peer(["default", "20 steps"]) == ["default", opensplat.ROW, "20 steps"]
    assert pareto.with_peer(["20 steps"]) == ["20 steps"]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["fortress", "highres/banana"])
def test_the_default_scene_lies_where_it_is_looked_for(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene that was not kept is made again; without it there is no row."""
    made = []

    def fake(inputs: list[Path], ply: Path, *options: str) -> dict[str, str]:
        made.append(ply)
        return {"error": "no photos"}

    monkeypatch.setattr(fullscreen, "reconstructed", fake)
    assert pareto.peer(PHOTO_SETS[name], tmp_path, tmp_path) is None
    assert made == [fullscreen.scene_file(PHOTO_SETS[name], pareto.DEFAULT, tmp_path)]
