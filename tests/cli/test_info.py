"""`querysplat info`: the numbers of a scene whose oddities are known."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.cli.info import _rows
from querysplat_cli.commands.info import describe
from querysplat_cli.reporting.report import Report
from querysplat_cli.reporting.stored_report import backdrop_of
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import NamedCameras
from querysplat_cli.scene.gaussians import Gaussians


def grid(side: int = 6) -> Gaussians:
    """Opaque round Gaussians on a grid of step 1; the last six are a needle, two giants, two faint ones, one alone."""
    n = side**3
    line = torch.arange(side, dtype=torch.float32)
    means = torch.cartesian_prod(line, line, line)
    scales = torch.full((n, 3), 0.2)
    opacities = torch.full((n,), 0.9)
    scales[-1, 0] = 2.1 * 0.2 * 5
    scales[-3:-1] = 3.0
    opacities[-5:-3] = 0.02
    means[-6] = 100.0
    scales[-1, 1:] = 0.2
    return Gaussians(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), scales, opacities, torch.zeros(n, 4, 3))


def test_the_odd_ones_are_counted() -> None:
    found = describe(grid(), None)
    assert {name: odd["count"] for name, odd in found["odd"].items()} == {
        "needles": 1,
        "giants": 3,  # the needle is as long
        "see_through": 2,
        "floaters": 1,
    }
    assert (found["gaussians"], found["sh_degree"], found["cameras"]) == (216, 1, None)
    assert found["extent"]["low"] == [0.0] * 3
    assert found["extent"]["high"] == [5.0] * 3
    assert found["extent"]["all"][1] == [100.0] * 3
    assert sum(found["opacity"]["counts"]) == sum(found["size"]["counts"]) == 216
    assert found["opacity"]["counts"][0] == 2
    assert found["opacity"]["quantiles"]["0.5"] == pytest.approx(0.9)


def test_the_backdrop_is_no_oddity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A whole report of this file says how many of the last Gaussians are the backdrop; `convert` reads it alike."""
    write_ply(tmp_path / "grid.ply", grid())
    (tmp_path / "grid").mkdir()
    report = Report(
        ply="grid.ply", scene="grid", views={"used": [], "left_out": []}, gaussians=216, seconds={}, quality={},
        left_out=[], warnings=[], tto=[], settings={"queries": None, "weights": None, "precision": "fp32"},
        peak_memory_gib=0.5, machine="", backdrop=6,
    )  # fmt: skip
    whole = report.as_dict()
    others = {**whole, "gaussians": 215}, {**whole, "backdrop": 217}, {"gaussians": 216, "backdrop": 6}
    for entries, behind, giants in ((whole, 6, 0), *((other, 0, 3) for other in others)):
        (tmp_path / "grid" / "report.json").write_text(json.dumps(entries))
        assert run(["info", str(tmp_path / "grid.ply"), "--json", "-q"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["gaussians"], found["backdrop"], found["odd"]["giants"]["count"]) == (216, behind, giants)
        assert backdrop_of(tmp_path / "grid", 216) == behind
        made = tmp_path / "without.ply"
        assert run(["convert", str(tmp_path / "grid.ply"), str(made), "--no-backdrop", "--json", "-q", "--force"]) == 0
        (step,) = json.loads(capsys.readouterr().out)["steps"]
        assert (step["what"], step["gaussians"], len(read_ply(made))) == ("no-backdrop", behind, 216 - behind)


def test_a_scene_of_nothing_but_its_backdrop_is_described() -> None:
    """`convert --crop` may leave no more of a scene."""
    found = describe(grid(), None, 216)
    assert {**found, "backdrop": 0} == describe(grid(), None)
    assert ("backdrop", "216 behind everything, and nothing else") in _rows({**found, "file": "", "bytes": 0})


def test_coordinates_whose_squares_are_beyond_float32(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians = grid()
    write_ply(tmp_path / "far.ply", replace(gaussians, means=1e36 * gaussians.means))
    assert run(["info", str(tmp_path / "far.ply"), "--json", "-q", "--plot", str(tmp_path / "far.png")]) == 0
    assert json.loads(capsys.readouterr().out)["extent"]["diagonal"] == pytest.approx(75**0.5 * 1e36)


def test_one_gaussian_is_a_scene() -> None:
    found = describe(grid()[:1], None)
    assert found["gaussians"] == 1
    assert found["odd"]["floaters"]["count"] == 0


def test_up_is_that_of_the_photos() -> None:
    """A camera that is rolled by 30 degrees sees up 30 degrees from -y."""
    w2c = torch.eye(4)[None]
    cosine, sine = 3**0.5 / 2, 0.5
    w2c[0, :2, :2] = torch.tensor([[cosine, sine], [-sine, cosine]])
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    cameras = NamedCameras(("a.jpg",), Cameras(w2c, K, 48, 64), ((48, 64),))
    assert describe(grid(), cameras)["orientation"]["tilt"] == pytest.approx(30, abs=0.01)


def test_the_verb_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "grid.ply", grid())
    drawing = tmp_path / "grid.png"
    assert run(["info", str(tmp_path / "grid.ply"), "--json", "--plot", str(drawing)]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["bytes"] == (tmp_path / "grid.ply").stat().st_size
    assert "216, SH degree 1" in printed.err
    assert "no cameras beside it" in printed.err
    assert drawing.stat().st_size > 10_000


def test_a_drawing_of_another_kind_is_refused_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(tmp_path / "none.ply"), "--plot", "a.gif"]) == ExitCode.BAD_INPUT
    assert "a.gif" in capsys.readouterr().err
    assert run(["info", str(tmp_path / "none.ply")]) == ExitCode.BAD_INPUT
