"""`querysplat convert` and `querysplat poses`, run as commands."""

import json
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.cli import run
from querysplat_cli.cli.convert import lines as convert_lines
from querysplat_cli.pipeline.gaussian_files import file_of_scene, read_gaussians
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import read_cameras, write_transforms
from querysplat_cli.scene.gaussians import Gaussians

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
from evaluation_scenes import write_room


def cameras(count: int = 4) -> dict[str, PhotoCamera]:
    found = {}
    for i in range(count):
        w2c = torch.eye(4, dtype=torch.float64).numpy()
        w2c[:3, :3] = Rotation.random(random_state=i).as_matrix()
        w2c[:3, 3] = [i, 0.1 * i * i, 2]
        lens = (0.1, -0.05, 0.001, 0.002) if i % 2 else (0.0, 0.0, 0.0, 0.0)
        found[f"photo_{i}.jpg"] = PhotoCamera(w2c, (500.0, 510.0), (320.0, 241.0), lens, 480, 640)
    return found


def write_gaussians(path: Path, means: list[list[float]]) -> None:
    count = len(means)
    generator = torch.Generator().manual_seed(0)
    write_ply(
        path,
        Gaussians(
            torch.tensor(means),
            torch.randn(count, 4, generator=generator),
            torch.full((count, 3), 0.1),
            torch.full((count,), 0.5),
            0.1 * torch.randn(count, 4, 3, generator=generator),
        ),
    )


def test_cameras_go_round(tmp_path: Path) -> None:
    """transforms.json → COLMAP binary → COLMAP text → transforms.json."""
    stations = [tmp_path / "a.json", tmp_path / "binary", tmp_path / "text", tmp_path / "b.json"]
    write_transforms(stations[0], cameras())
    for source, target in pairwise(stations):
        assert run(["convert", str(source), str(target), "-q", *(["--text"] if target.name == "text" else [])]) == 0
    assert {path.suffix for path in stations[1].iterdir()} == {".bin"}
    assert {path.suffix for path in stations[2].iterdir()} == {".txt"}
    for station in stations[1:]:
        found = read_known_cameras(station)
        assert found.keys() == cameras().keys()
        for name, camera in cameras().items():
            assert found[name].focal == pytest.approx(camera.focal)
            assert found[name].principal == pytest.approx(camera.principal)
            assert found[name].distortion == pytest.approx(camera.distortion)
            assert found[name].w2c == pytest.approx(camera.w2c, abs=1e-9)
    assert len(pycolmap.Reconstruction(stations[1]).cameras) == 2  # equal lenses are one camera


def test_photos_and_cameras_become_a_scene_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene keeps the cameras' frame, has undistorted photos, and suits every verb but `tto`."""
    room = tmp_path / "room"
    write_room(room, 3)
    content = json.loads((room / "transforms.json").read_text())
    content["frames"].append({**content["frames"][0], "file_path": "images/lost.png"})
    (room / "transforms.json").write_text(json.dumps({**content, "k1": 0.05}))
    cv2.imwrite(str(room / "images_4" / "unplaced.png"), np.zeros((100, 100, 3), np.uint8))
    assert run(["convert", str(room), str(tmp_path / "model"), "-q"]) == 0  # COLMAP with k1
    scene = tmp_path / "scene"
    arguments = ["convert", str(tmp_path / "model"), str(scene), "--photos", str(room)]
    assert run([*arguments, "--json", "-q"]) == 0
    said = json.loads(capsys.readouterr().out)
    names = [f"frame_{i:05d}.png" for i in (1, 2, 3)]
    assert (said["cameras"], [each["name"] for each in said["left_out"]]) == (3, ["unplaced.png", "lost.png"])
    assert [line.startswith("left out: unplaced.png (") for line in convert_lines(said)] == [False, True]
    assert convert_lines(said)[1].endswith("), lost.png (there is no photo of it)")
    assert sorted(path.name for path in scene.iterdir()) == ["cameras.json", "images"]
    given, made = read_known_cameras(room), read_known_cameras(scene)
    assert list(made) == names
    for name in names:
        assert made[name].w2c == pytest.approx(given[name].w2c, abs=1e-6)  # made a rotation again
        assert made[name].focal[0] * 4 > 1.01 * given[name].focal[0]  # less is seen, at the picture's own size
        assert made[name].distortion == (0, 0, 0, 0)
        height, width = cv2.imread(str(scene / "images" / name)).shape[:2]
        assert (made[name].height, made[name].width) == (height, width)
    assert read_cameras(scene / "cameras.json")[0].names == tuple(names)
    (found,) = find_scenes([scene])  # eval's door
    assert [frame.name for frame in found.frames] == list(found.cameras) == names

    write_gaussians(tmp_path / "scene.ply", [[0.0, 0.0, 3.0]])
    assert run(["render", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "frames"), "-q"]) == 0
    assert sorted(path.name for path in (tmp_path / "frames").glob("*.png")) == names
    assert run(["tto", str(scene)]) == ExitCode.BAD_INPUT
    assert "has no memories" in capsys.readouterr().err
    assert run([*arguments, "--text", "--force"]) == ExitCode.BAD_INPUT
    assert "--photos" in capsys.readouterr().err
    before = sorted(room.rglob("*"))
    assert run(["convert", str(room), str(room), "--photos", str(room), "--force"]) == ExitCode.BAD_INPUT
    assert "holds what is to be converted" in capsys.readouterr().err
    write_transforms(tmp_path / "others.json", cameras())
    strangers = ["convert", str(tmp_path / "others.json"), str(tmp_path / "none"), "--photos", str(room)]
    assert run(strangers) == ExitCode.BAD_INPUT
    assert "photo_0.jpg" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    assert sorted(room.rglob("*")) == before


def test_a_colmap_models_points_stay(tmp_path: Path) -> None:
    write_transforms(tmp_path / "a.json", cameras())
    assert run(["convert", str(tmp_path / "a.json"), str(tmp_path / "binary"), "-q"]) == 0
    model = pycolmap.Reconstruction(tmp_path / "binary")
    model.add_point3D([1.0, 2, 3], pycolmap.Track(), [9, 8, 7])
    model.write_binary(tmp_path / "binary")
    assert run(["convert", str(tmp_path / "binary"), str(tmp_path / "text"), "--text", "-q"]) == 0
    assert [list(point.xyz) for point in pycolmap.Reconstruction(tmp_path / "text").points3D.values()] == [[1, 2, 3]]


def test_a_folder_that_holds_two_sets_of_cameras_means_one(tmp_path: Path) -> None:
    """DL3DV's samples have a transforms.json beside the COLMAP model from which it was made."""
    home = tmp_path / "colmap"
    write_transforms(tmp_path / "few.json", cameras(2))
    assert run(["convert", str(tmp_path / "few.json"), str(home / "sparse" / "0"), "-q"]) == 0
    write_transforms(home / "transforms.json", cameras(4))
    assert run(["convert", str(home), str(tmp_path / "model"), "-q"]) == 0
    assert len(read_known_cameras(tmp_path / "model")) == len(read_known_cameras(home)) == 4


@pytest.mark.parametrize(
    ("axis", "up"),
    [("z", [0, 0, 1]), ("-z", [0, 0, -1]), ("x", [1, 0, 0]), ("-x", [-1, 0, 0]), ("y", [0, 1, 0]), ("-y", [0, -1, 0])],
)
def test_up_becomes_minus_y(tmp_path: Path, axis: str, up: list[float]) -> None:
    write_gaussians(tmp_path / "a.ply", [[float(part) for part in up], [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    assert run(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--up", axis, "--scale", "2", "-q"]) == 0
    turned = read_ply(tmp_path / "b.ply")
    assert turned.means[0].tolist() == pytest.approx([0, -2, 0], abs=1e-6)
    assert float(turned.means[2].norm()) == pytest.approx(2 * 14**0.5, rel=1e-6)
    assert turned.scales[0].tolist() == pytest.approx([0.2, 0.2, 0.2], rel=1e-5)


def test_crop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_gaussians(tmp_path / "a.ply", [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [5.0, 0.0, 0.0]])
    arguments = ["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]
    assert run([*arguments, "--scale", "2", "--crop=-1,-1,-1,3,3,3", "--json", "-q"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["gaussians"], said["left_out"]) == (2, 1)
    assert read_ply(tmp_path / "b.ply").means.tolist() == [[0, 0, 0], [2, 2, 2]]
    assert run([*arguments, "--crop=9,9,9,10,10,10", "--force"]) == ExitCode.BAD_INPUT
    assert len(read_ply(tmp_path / "b.ply")) == 2


def test_spz_is_turned_to_its_own_axes_and_back(tmp_path: Path) -> None:
    """SPZ has y up and z backward; .ply viewers expect y down and z forward."""
    gsply = pytest.importorskip("gsply")
    write_gaussians(tmp_path / "a.ply", [[1.0, 2.0, 3.0], [0.5, -0.25, 1.0]])
    assert run(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz"), "-q"]) == 0
    assert gsply.read_spz(tmp_path / "a.spz").means[0].tolist() == pytest.approx([1, -2, -3], abs=1e-4)
    assert run(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply"), "-q"]) == 0
    first, second = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    torch.testing.assert_close(second.means, first.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(second.sh, first.sh, atol=0.02, rtol=0)


@pytest.mark.parametrize(
    "arguments",
    [
        ["nowhere.ply", "b.ply"],
        ["a.ply", "b.obj"],
        ["a.ply", "b.compressed.ply"],
        ["a.ply", "b.ply", "--scale", "0"],
        ["a.ply", "b.ply", "--crop", "1,2,3"],
        ["a.ply", "b.ply", "--crop", "1,0,0,0,1,1"],
        ["a.json", "b.txt"],
        ["a.json", "b.json", "--photos", "."],
        ["a.json", "b", "--photos", "nowhere"],
        ["a.ply", "b.ply", "--photos", "."],
        ["a.ply", "b.ply", "--text"],
        ["a.json", "b.json", "--up", "z"],
        ["nowhere.json", "b.json"],
    ],
)
def test_bad_requests_write_nothing(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_gaussians(Path("a.ply"), [[0.0, 0.0, 0.0]])
    write_transforms(Path("a.json"), cameras())
    assert run(["convert", *arguments]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err.count("error: ") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.ply"]


def test_nothing_is_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_gaussians(tmp_path / "a.ply", [[0.0, 0.0, 0.0]])
    (tmp_path / "b.ply").write_text("mine")
    assert run(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]) == ExitCode.BAD_INPUT
    assert (tmp_path / "b.ply").read_text() == "mine"
    assert "there already" in capsys.readouterr().err


def test_the_folder_of_a_scene_stands_for_its_gaussians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_gaussians(tmp_path / "s.ply", [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    (tmp_path / "s").mkdir()
    assert run(["convert", str(tmp_path / "s"), str(tmp_path / "other.spz"), "-q"]) == 0
    assert len(read_gaussians(tmp_path / "other.spz")) == 2
    assert run(["convert", str(tmp_path / "s"), str(tmp_path / "other.txt")]) == ExitCode.BAD_INPUT
    assert "neither a transforms.json" in capsys.readouterr().err


def test_of_two_files_the_scenes_own_is_the_one_that_its_report_names(tmp_path: Path) -> None:
    """A scene of .spz that was also converted to .ply was optimised into the .ply alone."""
    for kind in ("ply", "spz"):
        (tmp_path / f"s.{kind}").touch()
    assert file_of_scene(tmp_path / "s") == tmp_path / "s.ply"
    (tmp_path / "s").mkdir()
    for report, kind in (('{"ply": "moved/s.spz"}', "spz"), ('{"ply": 3}', "ply"), ("[]", "ply"), ("{", "ply")):
        (tmp_path / "s" / "report.json").write_text(report)
        assert file_of_scene(tmp_path / "s") == tmp_path / f"s.{kind}"


def test_a_scene_is_found_by_its_folder_where_its_suffix_has_capital_letters(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s.PLY").touch()
    assert file_of_scene(tmp_path / "s") == tmp_path / "s.PLY"
    (tmp_path / "s.Spz").touch()
    (tmp_path / "s" / "report.json").write_text('{"ply": "s.Spz"}')
    assert file_of_scene(tmp_path / "s") == tmp_path / "s.Spz"


@pytest.mark.parametrize(("given", "said"), [("photo.jpg", "not a kind of file"), ("photos", "makes a scene of them")])
def test_photos_are_no_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str, said: str) -> None:
    (tmp_path / "photo.jpg").touch()
    (tmp_path / "photos").mkdir()
    assert run(["info", str(tmp_path / given)]) == ExitCode.BAD_INPUT
    assert said in capsys.readouterr().err


def test_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path / "a.json", cameras(6))
    assert run(["convert", str(tmp_path / "a.json"), str(tmp_path / "model"), "-q"]) == 0
    plot = tmp_path / "tracks.svg"
    arguments = ["poses", str(tmp_path / "a.json"), str(tmp_path / "model"), "--json", "-q", "--plot", str(plot)]
    assert run(arguments) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["photos"] == 6
    assert said["ate"] < 1e-9
    assert said["auc_5"] == pytest.approx(100, abs=1e-3)
    assert plot.is_file()
    assert run(arguments) == ExitCode.BAD_INPUT
    assert "there already" in capsys.readouterr().err
    assert run(["poses", str(tmp_path / "a.json")]) == ExitCode.BAD_INPUT
    assert "--colmap" in capsys.readouterr().err


def test_a_plot_of_another_kind_is_refused_ahead_of_colmap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path / "a.json", cameras(6))
    assert run(["poses", str(tmp_path / "a.json"), "--colmap", "--plot", "a.gif"]) == ExitCode.BAD_INPUT
    assert "not a kind of picture" in capsys.readouterr().err  # not that photos for COLMAP are missing


def test_cameras_that_are_no_rigid_motions_are_left_out_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = np.eye(4).tolist(), np.full((4, 4), np.nan).tolist()
    lens = {"w": 64, "h": 48, "fl_x": 50}
    frames = [{"file_path": f"{i}.png", "transform_matrix": matrix} for i, matrix in enumerate((good, bad))]
    source, target = tmp_path / "in.json", tmp_path / "out.json"
    source.write_text(json.dumps({**lens, "frames": frames}))
    assert run(["convert", str(source), str(target), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["cameras"], [each["name"] for each in said["left_out"]]) == (1, ["1.png"])
    assert list(read_known_cameras(target)) == ["0.png"]
    source.write_text(json.dumps({**lens, "frames": frames[1:]}))
    assert run(["convert", str(source), str(target), "--force", "-q"]) == ExitCode.BAD_INPUT
    assert "no camera of it is a rigid motion" in capsys.readouterr().err
