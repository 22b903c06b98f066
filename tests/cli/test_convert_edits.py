"""`querysplat convert` cleans, turns and cuts Gaussians, says what that costs, and takes the scene's folder along."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from plyfile import PlyData

from querysplat_cli.cli import run
from querysplat_cli.cli.convert import lines as convert_lines
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import read_cameras, read_working_cameras, write_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile, write_photo_files
from querysplat_cli.scene.views import PhotoSource, Views
from querysplat_cli.splat.render import render

BODY = 600


def plain(means: torch.Tensor, scale: float) -> Gaussians:
    count = len(means)
    random = torch.Generator().manual_seed(1)
    return Gaussians(
        means,
        torch.randn(count, 4, generator=random),
        torch.full((count, 3), scale),
        torch.full((count,), 0.8),
        0.3 * torch.randn(count, 4, 3, generator=random),
    )


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A rough wall at z = 4, two touching Gaussians apart from it, a faint giant, and one behind all cameras."""
    x, y = torch.meshgrid(torch.linspace(-1.2, 1.2, 30), torch.linspace(-0.9, 0.9, 20), indexing="xy")
    depth = 4 + 0.2 * torch.rand(x.shape, generator=torch.Generator().manual_seed(0))  # no two at one depth
    wall = torch.stack([x, y, depth], -1).reshape(-1, 3)
    others = torch.tensor([[1.5, 1.0, 3.0], [1.51, 1.0, 3.0], [0.0, 0, 6], [0.0, 0.0, -30.0]])
    everything = plain(torch.cat([wall, others]), 0.04)
    everything.scales[BODY + 2], everything.opacities[BODY + 2] = 3.0, 0.004  # less than one of 255 levels
    write_ply(tmp_path / "s.ply", everything)
    w2c = torch.eye(4).repeat(3, 1, 1)
    w2c[:, 0, 3] = torch.tensor([-0.5, 0.0, 0.5])
    K = torch.tensor([[160.0, 0, 96], [0, 160, 72], [0, 0, 1]]).repeat(3, 1, 1)
    views = Views(
        torch.zeros(3, 3, 144, 192), torch.ones(3, 144, 192).bool(), ("a.png", "b.png", "c.png"), ((144, 192),) * 3
    )
    (tmp_path / "s").mkdir()
    write_cameras(tmp_path / "s" / "cameras.json", Cameras(w2c, K, 144, 192), views)
    return tmp_path / "s.ply"


def converted(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert run(["convert", *map(str, arguments), "--json", "-q"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_cleaning_says_what_went_and_why(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = converted(capsys, scene, tmp_path / "c.ply", "--clean")
    (step,) = said["steps"]
    assert (step["what"], step["gaussians"]) == ("clean", 4)
    assert (step["unsupported"], step["giants"], step["islands"]) == (1, 1, 2)
    assert said["gaussians"] == len(read_ply(tmp_path / "c.ply")) == BODY
    assert (said["psnr"]["against"], said["psnr"]["views"], said["psnr"]["before"]) == ("inputs", 3, 100)
    assert 40 < said["psnr"]["after"] < 60  # the giant could hardly be seen
    assert said["psnr"]["after"] == pytest.approx(step["psnr"], abs=0.01)


def test_a_giant_that_photos_need_stays(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(scene, replace(read_ply(scene), opacities=torch.full((BODY + 4,), 0.8)))
    said = converted(capsys, scene, tmp_path / "c.ply", "--clean")
    assert (said["steps"][0]["giants"], said["gaussians"]) == (0, BODY + 1)
    assert said["psnr"]["after"] > 40


def test_what_only_one_of_many_photos_shows_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """PSNR is that of 8 of these 16 photos, but each of them shows a patch of its own."""
    count, size = 16, 24
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = -10.0 * torch.arange(count)
    patch = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 4.0])
    places = torch.cat([patch + torch.tensor([10.0 * view, 0, 0]) for view in range(count)])
    write_ply(tmp_path / "s.ply", plain(places, 0.1))
    (tmp_path / "s").mkdir()
    K = torch.tensor([[24.0, 0, 12], [0, 24, 12], [0, 0, 1]]).repeat(count, 1, 1)
    names = tuple(f"{view}.png" for view in range(count))
    views = Views(
        torch.zeros(count, 3, size, size), torch.ones(count, size, size).bool(), names, ((size, size),) * count
    )
    write_cameras(tmp_path / "s" / "cameras.json", Cameras(w2c, K, size, size), views)
    for option in (["--clean"], ["--prune", "160"]):
        said = converted(capsys, tmp_path / "s.ply", tmp_path / "t.ply", *option, "--force")
        assert said["psnr"]["views"] == 8
        kept = read_ply(tmp_path / "t.ply").means[:, 0]
        assert len({round(float(x) / 10) for x in kept}) == count


def test_a_file_that_replaces_its_source_is_compared_with_the_size_before(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = tmp_path / "alone.ply"
    alone.write_bytes(scene.read_bytes())
    before = alone.stat().st_size
    said = converted(capsys, alone, alone, "--prune", "100", "--force")
    assert said["bytes"] == {"source": before, "target": alone.stat().st_size}


def test_a_loss_has_no_sign_and_can_be_a_gain() -> None:
    psnr = {"against": "photos", "views": 7, "before": 25.07, "after": 25.072, "lost": -0.002}
    result = {"gaussians": 1, "bytes": {"target": 1, "source": 1}, "target": "a.spz", "scene": None, "steps": []}
    assert convert_lines({**result, "psnr": psnr})[-1] == "on 7 of the photos: 25.07 → 25.07 dB, 0.00 dB lost"
    gain = {**psnr, "after": 25.08, "lost": -0.01}
    assert convert_lines({**result, "psnr": gain})[-1] == "on 7 of the photos: 25.07 → 25.08 dB, 0.01 dB gained"


def test_a_step_without_photos_states_how_far_pictures_agree() -> None:
    """They agree with themselves by 100 dB, so that 40 dB less is no loss that anybody sees."""
    step = {"what": "clean", "gaussians": 4, "giants": 4, "psnr": 60.0, "lost": 40.0, "against": "orbit"}
    psnr = {"against": "orbit", "views": 8, "before": 100.0, "after": 60.0, "lost": 40.0}
    result = {"gaussians": 1, "bytes": {"target": 1, "source": 1}, "target": "a.ply", "scene": None, "psnr": psnr}
    assert convert_lines({**result, "steps": [step]})[1] == "clean: 4 left out (4 giant), pictures agree to 60.00 dB"
    said = convert_lines({**result, "steps": [{**step, "against": "photos", "lost": 0.5}], "psnr": None})
    assert said[-1] == "clean: 4 left out (4 giant), 0.50 dB lost"


def test_without_cameras_a_scene_is_cleaned_too(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scene.with_suffix("") / "cameras.json").unlink()
    said = converted(capsys, scene, tmp_path / "c.ply", "--clean")
    assert (said["psnr"]["against"], said["scene"]) == ("orbit", None)
    (step,) = said["steps"]
    assert (step["unsupported"], step["giants"], step["islands"]) == (0, 1, 3)
    assert run(["convert", str(scene), str(tmp_path / "d.ply"), "--up", "auto"]) == ExitCode.BAD_INPUT
    assert "has no cameras.json" in capsys.readouterr().err


def test_boxes_spheres_and_numbers(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    means = read_ply(scene).means
    left = int((means[:, 0] <= 0).sum())
    said = converted(capsys, scene, tmp_path / "r.ply", "--remove=-9,-9,-99,0,9,99", "--force")
    assert said["steps"][0]["gaussians"] == left
    said = converted(capsys, scene, tmp_path / "k.ply", "--keep-sphere", "0,0,8,1", "--scale", "2", "--prune", "60")
    near = int(((2 * means - torch.tensor([0.0, 0, 8])).norm(dim=1) <= 1).sum())
    assert [step["what"] for step in said["steps"]] == ["keep-sphere", "prune"]
    assert said["steps"][0]["gaussians"] == len(means) - near
    assert said["gaussians"] == 60 < near
    assert said["steps"][1]["psnr"] <= said["steps"][0]["psnr"]


def test_the_folder_goes_along_and_the_pictures_stay(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Turned in any direction, and scaled; the costs count nothing but rounding."""
    said = converted(capsys, scene, tmp_path / "t.ply", "--up=0.3,0.5,-0.8", "--scale", "3")
    assert said["scene"] == str(tmp_path / "t")
    assert said["psnr"]["after"] > 60
    before, after = (read_cameras(tmp_path / name / "cameras.json")[0].cameras for name in ("s", "t"))
    pictures = [render(read_ply(tmp_path / f"{n}.ply"), each).colour for n, each in (("s", before), ("t", after))]
    assert float(pictures[0].std()) > 0.05
    assert float((pictures[0] - pictures[1]).square().mean()) < 1e-6
    working, _, frame = read_working_cameras(tmp_path / "t" / "cameras.json")
    assert frame is not None
    assert frame.scale == pytest.approx(3)
    torch.testing.assert_close(working.cameras.w2c, before.w2c, atol=1e-5, rtol=0)


def test_auto_turns_the_photos_to_the_front(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    converted(capsys, scene, tmp_path / "t.ply", "--up", "z")
    converted(capsys, tmp_path / "t.ply", tmp_path / "u.ply", "--up", "auto")
    cameras = read_cameras(tmp_path / "u" / "cameras.json")[0].cameras
    assert (cameras.w2c[:, 1, 1] > 0.99).all()
    forward = cameras.w2c[:, 2, :3].mean(0)
    torch.testing.assert_close(forward, torch.tensor([0.5**0.5, 0, -(0.5**0.5)]), atol=0.01, rtol=0)


def test_what_fits_a_scene_no_more_is_not_put_beside_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["convert", str(scene), str(tmp_path / "s.spz"), "--up", "z"]) == ExitCode.BAD_INPUT
    assert "Choose another name" in capsys.readouterr().err
    assert not (tmp_path / "s.spz").exists()
    said = converted(capsys, scene, tmp_path / "s.spz")
    assert said["scene"] is None
    (tmp_path / "there").mkdir()
    assert run(["convert", str(scene), str(tmp_path / "there.ply"), "--clean"]) == ExitCode.BAD_INPUT
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s", "s.ply", "s.spz", "there"]


@pytest.mark.parametrize(
    "option",
    ["--scale=inf", "--scale=nan", "--up=0,0,0", "--up=w", "--up=1,2", "--up=nan,0,1", "--remove=0,0,0,1,1",
     "--keep-sphere=0,0,0,-1", "--keep-sphere=0,0,1", "--crop=8,8,8,9,9,9", "--prune=0", "--crop=nan,0,0,1,1,1"],
)  # fmt: skip
def test_senseless_options_are_refused(scene: Path, tmp_path: Path, option: str) -> None:
    assert run(["convert", str(scene), str(tmp_path / "x.ply"), option]) == ExitCode.BAD_INPUT
    assert not (tmp_path / "x.ply").exists()


def test_a_file_without_a_finite_gaussian_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "a.ply", plain(torch.zeros(2, 3), 0.1))
    content = bytearray((tmp_path / "a.ply").read_bytes())
    body = content.index(b"end_header\n") + len(b"end_header\n")
    content[body:] = b"\xff" * (len(content) - body)  # every float32 is a NaN
    (tmp_path / "a.ply").write_bytes(content)
    assert run(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]) == ExitCode.BAD_INPUT
    assert "no Gaussian with finite numbers" in capsys.readouterr().err


def test_points_are_the_opaque_gaussians(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = converted(capsys, scene, tmp_path / "p.ply", "--points", "--scale", "2", "--clean")
    vertices = PlyData.read(str(tmp_path / "p.ply"))["vertex"].data
    assert said["points"] == len(vertices) == BODY
    assert said["psnr"] is said["scene"] is None
    assert vertices.dtype.names == ("x", "y", "z", "red", "green", "blue")
    assert vertices["z"].min() >= 8
    assert len(np.unique(vertices["red"])) > 20
    assert run(["convert", str(scene), str(tmp_path / "p.spz"), "--points"]) == ExitCode.BAD_INPUT


def test_a_scene_becomes_a_colmap_model_of_its_photos(scene: Path, tmp_path: Path) -> None:
    """The lens is that of the photo, at the size of its file; the pinhole cameras are those of cameras.json."""
    folder = scene.with_suffix("")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((600, 800, 3), np.uint8))
    lens = PhotoCamera(np.eye(4), (500.0, 505.0), (320.0, 241.0), (0.1, -0.02, 0.001, 0.0), 480, 640)
    files = [PhotoFile.of(name, PhotoSource(tmp_path / name), lens) for name in ("a.png", "b.png")]  # b.png is gone
    write_photo_files(folder / "photos.json", files)
    assert run(["convert", str(folder), str(tmp_path / "model"), "-q"]) == 0
    found = read_known_cameras(tmp_path / "model")
    poses = read_known_cameras(folder / "cameras.json")
    assert found["a.png"].distortion == pytest.approx(lens.distortion)
    assert (found["a.png"].height, found["a.png"].width) == (600, 800)
    assert found["a.png"].focal == pytest.approx((625.0, 631.25))
    assert (found["b.png"].height, found["b.png"].focal) == (480, pytest.approx(lens.focal))
    assert (found["c.png"].width, found["c.png"].distortion) == (192, (0, 0, 0, 0))  # no lens is known
    for name, camera in poses.items():
        assert found[name].w2c == pytest.approx(camera.w2c, abs=1e-6)
    assert len(pycolmap.Reconstruction(tmp_path / "model").points3D) == BODY + 3  # all but the faint one
    assert run(["convert", str(folder / "cameras.json"), str(tmp_path / "small"), "-q"]) == 0
    assert {camera.width for camera in read_known_cameras(tmp_path / "small").values()} == {192}


def test_float_depth_is_that_of_the_surface(scene: Path, tmp_path: Path) -> None:
    assert run(["render", str(scene), "-o", str(tmp_path / "frames"), "--float-depth", "-q"]) == 0
    depth = np.load(tmp_path / "frames" / "b_depth.npy")
    confidence = np.load(tmp_path / "frames" / "b_confidence.npy")
    assert depth.dtype == confidence.dtype == np.float32
    assert depth.shape == confidence.shape == (144, 192)
    assert 0 <= confidence.min() <= confidence.max() <= 1
    assert 3.5 < depth[72, 96] < 6.5


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_a_mesh_is_the_surface_in_the_frame_of_the_result(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    trimesh = pytest.importorskip("trimesh")
    target = tmp_path / f"m.{kind}"
    said = converted(capsys, scene, target, "--mesh", "--scale", "2", "--clean")
    assert said["psnr"] is said["scene"] is None
    assert said["bytes"]["target"] == target.stat().st_size
    found = trimesh.load(target, process=False, force="mesh")
    assert (len(found.vertices), len(found.faces)) == (said["corners"], said["triangles"])
    assert len(np.unique(found.visual.vertex_colors[:, 0])) > 20
    y_up = -1 if kind == "glb" else 1
    assert 7.5 < np.median(y_up * found.vertices[:, 2]) < 9  # the wall's depth, twice
    assert (y_up * found.face_normals[:, 2] < 0).mean() > 0.8  # towards the cameras


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [("m.spz", ["--mesh"], "meshes"), ("m.obj", [], "--mesh"), ("m.ply", ["--mesh", "--points"], "two files")],
)
def test_other_kinds_of_meshes_are_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, options: list[str], words: str
) -> None:
    assert run(["convert", str(scene), str(tmp_path / name), *options]) == ExitCode.BAD_INPUT
    assert words in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_without_its_packages_a_mesh_names_the_command_that_brings_them(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert run(["convert", str(scene), str(tmp_path / "m.glb"), "--mesh"]) == ExitCode.MISSING_PART
    assert capsys.readouterr().err.splitlines() == ["error: meshes need trimesh", "  pip install 'querysplat[mesh]'"]
    assert not (tmp_path / "m.glb").exists()
