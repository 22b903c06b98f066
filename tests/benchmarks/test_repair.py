"""Scene repair: a region is taken out, restored in pictures, and lifted back."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import repair
from querysplat_cli.cli import run
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import write_cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians, joined
from querysplat_cli.scene.views import Views

SIZE = (72, 96)
BOX = (-0.35, -0.35, 2.0, 0.35, 0.35, 2.6)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red ball in front of a patterned wall, and three cameras."""
    home = tmp_path_factory.mktemp("scene")
    K = torch.tensor([[90.0, 0, SIZE[1] / 2], [0, 90, SIZE[0] / 2], [0, 0, 1]]).repeat(3, 1, 1)
    w2c = torch.eye(4).repeat(3, 1, 1)
    w2c[:, 0, 3] = torch.tensor([-0.3, 0.0, 0.3])
    cameras = Cameras(w2c, K, *SIZE)
    pattern = torch.nn.functional.interpolate(
        torch.rand(1, 3, 18, 24, generator=torch.Generator().manual_seed(0)), SIZE, mode="bicubic"
    ).clamp(0, 1)
    masks = torch.ones(3, *SIZE, dtype=torch.bool)
    views = Views(pattern.expand(3, -1, -1, -1).contiguous(), masks, ("a.png", "b.png", "c.png"), (SIZE,) * 3)
    wall = back_project(views, cameras, torch.full((3, *SIZE), 4.0))
    red = torch.full((8, 1, 3), -0.5 / SH_0)
    red[:, 0, 0] = 0.5 / SH_0
    means = torch.tensor([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (2.2, 2.4)])
    ball = Gaussians(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(8, 1), torch.full((8, 3), 0.12), torch.full((8,), 0.99), red
    )
    write_ply(home / "scene.ply", joined(wall, ball))
    (home / "scene").mkdir()
    write_cameras(home / "scene" / "cameras.json", cameras, views)
    return home / "scene.ply"


def rebuilt(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """`reconstruct` is replaced by splats of the restored pictures at the wall's depth. Returns what is run."""
    real, seen = repair._querysplat, []

    def fake(*arguments: str) -> None:
        seen.append(arguments)
        if arguments[0] != "reconstruct":
            real(*arguments)
            return
        from querysplat_cli.scene.formats.transforms import read_cameras

        folder, out = Path(arguments[1]), Path(arguments[3])
        named = read_cameras(folder / "cameras.json")[0]
        pictures = [cv2.imread(str(folder / name))[..., ::-1].copy() for name in named.names]
        images = torch.stack([torch.from_numpy(pixels).permute(2, 0, 1).float() / 255 for pixels in pictures])
        views = Views(images, torch.ones(3, *SIZE, dtype=torch.bool), named.names, named.sizes)
        write_ply(out, back_project(views, named.cameras, torch.full((3, *SIZE), 4.0), stride=1))

    monkeypatch.setattr(repair, "_querysplat", fake)
    return seen


def test_the_region_goes_and_comes_back(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = rebuilt(monkeypatch)
    damaged, restored, repaired = repair.repair(scene, BOX, tmp_path / "out", repair.inpaint)
    assert [verb for verb, *_ in seen] == ["render", "render", "reconstruct", "render"]
    assert len(read_ply(scene)) - len(read_ply(tmp_path / "out" / "damaged.ply")) == 8
    mask = cv2.imread(str(tmp_path / "out" / "holes" / "b.png"), 0)
    assert mask[SIZE[0] // 2, SIZE[1] // 2] == 255
    assert mask[:5].max() == 0
    assert 0.01 < (mask > 0).mean() < 0.4
    # The whole scene has the ball, which nothing brings back; outside of the region all stays.
    assert damaged.outside > 45
    assert restored.outside > 45
    assert repaired.outside > 20
    names = [file.name for file in sorted((tmp_path / "out" / "restored").iterdir())]
    assert names == ["a.png", "b.png", "c.png", "cameras.json"]


def test_the_figure_shows_the_stages_where_the_hole_is_largest(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through the program's own options. The hole of the last view is then made larger than the others."""
    rebuilt(monkeypatch)
    out, figure, results = (tmp_path / name for name in ("out", "figures/repair.jpg", "repair.json"))
    given = [str(scene), f"--box={','.join(map(str, BOX))}", "-o", str(out)]
    monkeypatch.setattr(sys, "argv", ["repair.py", *given, "--figure", str(figure), "--json", str(results)])
    repair.main()
    assert figure.read_bytes().startswith(b"\xff\xd8")
    stages = json.loads(results.read_text())["stages"]
    assert [stage["name"] for stage in stages] == ["damaged", "restored pictures", "repaired scene"]
    cv2.imwrite(str(out / "holes" / "c.png"), np.full(SIZE, 255, np.uint8))
    repair.write_figure(figure, out)
    strip = cv2.imread(str(figure)).astype(float)
    assert strip.shape == (SIZE[0], 4 * SIZE[1], 3)
    folders = ("whole", "damaged", "restored", "repaired-renders")
    for panel, folder in zip(np.split(strip, 4, axis=1), folders, strict=True):
        differences = {
            (stage, name): np.abs(panel - cv2.imread(str(out / stage / name))).mean()
            for stage in folders
            for name in ("a.png", "b.png", "c.png")
        }
        assert min(differences, key=lambda key: differences[key]) == (folder, "c.png")


def test_the_restored_pictures_become_a_scene(scene: Path, tmp_path: Path) -> None:
    """Through `reconstruct` itself: its scene lies in the old frame, and shows all of the pictures."""
    *_, repaired = repair.repair(scene, BOX, tmp_path / "out", repair.inpaint, options="--quality draft --tto 20")
    assert repaired.outside > 20


def test_what_is_cut_is_what_convert_removes(scene: Path, tmp_path: Path) -> None:
    removed = ["convert", str(scene), str(tmp_path / "less.ply"), f"--remove={','.join(map(str, BOX))}", "-q"]
    assert run(removed) == ExitCode.DONE
    found, expected = read_ply(tmp_path / "less.ply"), repair.cut(read_ply(scene), BOX)
    torch.testing.assert_close(vars(found), vars(expected))


def test_any_command_restores(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This one brings the truth back, so that the region is whole again in the pictures and in the scene."""
    rebuilt(monkeypatch)
    whole = tmp_path / "out" / "whole"
    script = tmp_path / "restore.py"
    lines = (
        "import pathlib, shutil, sys",
        f"shutil.copy(pathlib.Path({str(whole)!r}, pathlib.Path(sys.argv[1]).name), sys.argv[2])",
    )
    script.write_text("\n".join(lines))
    restore = repair.command(f"{sys.executable} {script} {{picture}} {{restored}}")
    damaged, restored, repaired = repair.repair(scene, BOX, tmp_path / "out", restore)
    assert damaged.inside < 15
    assert restored.inside > 60
    assert repaired.inside > damaged.inside + 2


def test_commands_that_do_not_restore_are_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="names no"):
        repair.command("cp {picture} elsewhere")
    picture = tmp_path / "a.png"
    cv2.imwrite(str(picture), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="exit code"):
        repair.command("true {restored}")(picture, picture, tmp_path / "b.png")
    with pytest.raises(QuerySplatError, match="cannot be run"):
        repair.command("no-such-program {restored}")(picture, picture, tmp_path / "b.png")
    with pytest.raises(QuerySplatError, match="no centre of a Gaussian"):
        repair.cut(read_ply(scene), (9.0, 9.0, 9.0, 10.0, 10.0, 10.0))


@pytest.mark.slow
def test_a_real_scene_is_repaired_end_to_end(scene: Path, tmp_path: Path) -> None:
    """With `reconstruct` itself: the scene of the restored pictures stays in the frame of the old one."""
    options = "--quality draft --tto 10 --max-size 96"
    *_, repaired = repair.repair(scene, BOX, tmp_path / "out", repair.inpaint, options=options)
    assert repaired.outside > 18
    assert (tmp_path / "out" / "repaired.ply").is_file()
