"""`querysplat convert` to levels of detail and back, run as a command."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.commands.convert_levels import coarser_levels
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.formats.ply import read_ply, write_ply

sys.path.insert(0, str(Path(__file__).parents[1] / "scene"))
from test_compressed import cloud


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_ply(tmp_path / "scene.ply", cloud(200, 1))
    return tmp_path / "scene.ply"


def converted(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert run(["convert", *map(str, arguments), "--json", "-q"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_levels_of_detail_and_back(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A .lod says what each level costs; the finest comes back no worse than from a .sog."""
    target = tmp_path / "out.lod"
    said = converted(capsys, scene, f"{target}/", "--levels", 2)
    assert [level["gaussians"] for level in said["levels"]] == [200, 100, 50]
    levels = [level["psnr"] for level in said["levels"]]
    assert levels == sorted(levels, reverse=True)
    assert said["psnr"]["after"] == pytest.approx(levels[0], abs=1e-3)
    assert said["bytes"]["target"] == sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
    assert (said["gaussians"], said["left_out"]) == (200, 0)
    whole = converted(capsys, scene, tmp_path / "one.sog")
    assert said["psnr"]["after"] > whole["psnr"]["after"] - 1
    back = converted(capsys, target / "lod-meta.json", tmp_path / "back.ply")
    assert back["gaussians"] == 200
    assert torch.cdist(read_ply(scene).means, read_ply(tmp_path / "back.ply").means).min(1).values.max() < 2e-3
    assert run(["info", str(target), "--json", "-q"]) == 0  # other verbs read it as well
    assert json.loads(capsys.readouterr().out)["bytes"] == said["bytes"]["target"]


def test_lines_and_refusals(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "out.lod"
    assert run(["convert", str(scene), str(target)]) == 0
    said = capsys.readouterr()
    assert "level 1: 100 Gaussians, " in said.out + said.err
    before = sorted(tmp_path.rglob("*"))
    for arguments, message in (
        ([scene, target], "there already"),
        ([scene, tmp_path / "b.sog", "--levels", "2"], "--levels"),
        ([target, target, "--force"], "Choose another target"),
        ([scene, tmp_path / "b.lod", "--mesh"], "meshes"),
        ([tmp_path / "none.lod", tmp_path / "b.ply"], "no such file"),
    ):
        assert run(["convert", *map(str, arguments)]) == ExitCode.BAD_INPUT
        assert message in " ".join(capsys.readouterr().err.split())
    assert run(["info", str(tmp_path / "out")]) == ExitCode.BAD_INPUT
    assert f"Give {target}" in " ".join(capsys.readouterr().err.split())
    (target / "lod-meta.json").write_text("{}")
    assert run(["convert", str(target / "lod-meta.json"), str(tmp_path / "b.ply")]) == ExitCode.BAD_INPUT
    assert "damaged" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_how_many_levels_there_are() -> None:
    """The coarsest has at most a million, and there is one coarser level at least."""
    wanted = {1: 1, 10**6: 1, 2 * 10**6: 1, 2 * 10**6 + 1: 2, 10**7: 4}
    assert {count: coarser_levels(count) for count in wanted} == wanted
