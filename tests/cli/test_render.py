"""`querysplat render` on a small .ply: every kind of output, and every way to choose the cameras."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.film_colours import BT709, LIMITED
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.transforms import write_cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Views

SIZE = (48, 64)


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """One opaque red ball of radius about ½ at (0, 0, 4), and three specks too small to matter."""
    sh = torch.full((4, 1, 3), -0.5 / SH_0)
    sh[:, 0, 0] = 0.5 / SH_0
    means = torch.tensor([[0.0, 0, 4], [0.1, 0, 4], [-0.1, 0, 4], [0, 0.1, 4]])
    gaussians = Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        torch.tensor([[0.2], [0.001], [0.001], [0.001]]).repeat(1, 3),
        torch.tensor([0.999, 0.1, 0.1, 0.1]),
        sh,
    )
    write_ply(tmp_path / "ball.ply", gaussians)
    return tmp_path / "ball.ply"


def give_cameras(ply: Path, names: tuple[str, ...]) -> None:
    K = torch.tensor([[60.0, 0, SIZE[1] / 2], [0, 60, SIZE[0] / 2], [0, 0, 1]]).repeat(len(names), 1, 1)
    w2c = torch.eye(4).repeat(len(names), 1, 1)
    w2c[:, 0, 3] = torch.linspace(0, 0.5, len(names))
    images = torch.zeros(len(names), 3, *SIZE)
    views = Views(images, torch.ones(len(names), *SIZE, dtype=torch.bool), names, (SIZE,) * len(names))
    ply.with_suffix("").mkdir()
    write_cameras(ply.with_suffix("") / "cameras.json", Cameras(w2c, K, *SIZE), views)


def test_the_input_cameras_with_depth_and_alpha(ball: Path, capsys: pytest.CaptureFixture[str]) -> None:
    give_cameras(ball, ("left.jpg", "right.jpg"))
    out = ball.parent / "frames"
    assert run(["render", str(ball), "-o", str(out), "--depth", "--alpha", "--background", "0,0,1", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["frames"], said["gaussians"], said["output"]) == (2, 4, str(out))
    pictures = sorted(f"{name}{part}.png" for name in ("left", "right") for part in ("", "_alpha", "_depth"))
    assert sorted(path.name for path in out.iterdir()) == ["cameras.json", *pictures]
    colour = cv2.imread(str(out / "left.png"))
    alpha = cv2.imread(str(out / "left_alpha.png"), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(out / "left_depth.png"), cv2.IMREAD_UNCHANGED)
    assert colour.shape == (*SIZE, 3)
    assert alpha.shape == depth.shape == SIZE
    middle, corner = (SIZE[0] // 2, SIZE[1] // 2), (0, 0)
    assert colour[middle][2] > 200
    assert colour[middle][0] < 40
    assert tuple(colour[corner]) == (255, 0, 0)
    assert alpha[middle] > 230
    assert alpha[corner] == 0
    assert abs(int(depth[middle]) - 4000) < 5
    assert depth[corner] == 0


def test_names_that_differ_in_their_suffix_alone(ball: Path) -> None:
    give_cameras(ball, ("one.jpg", "one.png"))
    assert run(["render", str(ball), "-o", str(ball.parent / "frames"), "-q"]) == 0
    assert len(list((ball.parent / "frames").glob("*.png"))) == 2


@pytest.mark.parametrize("part", ["depth", "alpha"])
def test_two_pictures_of_one_name_are_refused(ball: Path, part: str, capsys: pytest.CaptureFixture[str]) -> None:
    give_cameras(ball, ("a.jpg", f"a_{part}.jpg"))
    command = ["render", str(ball), "-o", str(ball.parent / "frames"), "-q"]
    assert run([*command, f"--{part}"]) == ExitCode.BAD_INPUT
    assert f"a_{part}.png" in capsys.readouterr().err
    assert not (ball.parent / "frames").exists()
    assert run(command) == ExitCode.DONE


def test_two_cameras_of_one_name_are_refused_but_for_a_film(ball: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A path whose frames all name one picture: each picture replaced the one before, without a word."""
    give_cameras(ball, ("a.jpg", "b.jpg"))
    path = ball.parent / "path.json"
    path.write_text((ball.with_suffix("") / "cameras.json").read_text().replace("b.jpg", "a.jpg"))
    command = ["render", str(ball), "--cameras", str(path), "-q", "-o"]
    assert run([*command, str(ball.parent / "frames")]) == ExitCode.BAD_INPUT
    assert "several cameras are called a.jpg" in capsys.readouterr().err
    assert not (ball.parent / "frames").exists()
    assert run([*command, str(ball.parent / "film.mp4")]) == ExitCode.DONE


def test_a_film_of_a_scene_without_cameras(ball: Path) -> None:
    film = ball.parent / "film.mp4"
    assert run(["render", str(ball), "-o", str(film), "--frames", "8", "--fps", "24", "--size", "81x61", "-q"]) == 0
    with av.open(str(film)) as opened:
        pictures = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
        assert opened.streams.video[0].average_rate == 24
    assert [picture.shape for picture in pictures] == [(60, 80, 3)] * 8
    assert all(np.asarray(picture)[30, 40, 0] > 150 for picture in pictures)


@pytest.mark.parametrize("unit", [1000.0, 0.002])
@pytest.mark.parametrize("given", [True, False], ids=["cameras in a file", "orbit"])
def test_files_of_other_programs_may_have_any_unit(ball: Path, unit: float, given: bool) -> None:
    """The splatter's near and far suit the units that scenes are made in: in others, pictures were black."""
    give_cameras(ball, ("left.jpg", "right.jpg"))
    cameras = ball.with_name("cameras.json")
    ball.with_suffix("").joinpath("cameras.json").rename(cameras)
    pictures = []
    for scale in (1.0, unit):
        scene = read_ply(ball)
        write_ply(ball.with_name("other.ply"), replace(scene, means=scale * scene.means, scales=scale * scene.scales))
        listed = json.loads(cameras.read_text())
        for frame in listed["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= scale
        ball.with_name("moved.json").write_text(json.dumps(listed))
        chosen = ["--cameras", str(ball.with_name("moved.json"))] if given else ["--frames", "2", "--size", "64x48"]
        out = ball.with_name(f"frames{scale}")
        assert run(["render", str(ball.with_name("other.ply")), "-o", str(out), *chosen, "--depth", "-q"]) == 0
        pictures.append([cv2.imread(str(path)) for path in sorted(out.glob("*[!h].png"))])
    assert max(picture.max() for picture in pictures[0]) > 200
    np.testing.assert_allclose(pictures[0], pictures[1], atol=2)


@pytest.mark.parametrize(
    ("options", "frames"),
    [(["--fps", "10"], 30), (["--seconds", "1", "--fps", "8"], 8), (["--cameras", "orbit", "--seconds", "2"], 60)],
)
def test_a_film_of_few_cameras_is_a_smooth_path_through_them(options: list[str], frames: int, ball: Path) -> None:
    give_cameras(ball, ("left.jpg", "right.jpg"))
    film = ball.parent / "film.mp4"
    assert run(["render", str(ball), "-o", str(film), "--size", "40x30", "-q", *options]) == 0
    with av.open(str(film)) as opened:
        pictures = [frame.to_ndarray(format="rgb24").astype(float) for frame in opened.decode(video=0)]
    assert len(pictures) == frames
    steps = [np.abs(one - two).mean() for one, two in pairwise(pictures)]
    assert max(steps) < max(0.5 * np.abs(pictures[0] - pictures[len(pictures) // 2]).mean(), 12)


def give_portrait_and_landscape(ply: Path) -> None:
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]).repeat(2, 1, 1)
    K[1, :2, 2] = torch.tensor([24.0, 32.0])
    views = Views(torch.zeros(2, 3, 64, 64), torch.ones(2, 64, 64, dtype=torch.bool), ("a", "b"), (SIZE, SIZE[::-1]))
    ply.with_suffix("").mkdir()
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), K, 64, 64)
    write_cameras(ply.with_suffix("") / "cameras.json", cameras, views)


def test_a_film_through_portrait_and_landscape_photos_shows_the_middle(ball: Path) -> None:
    give_portrait_and_landscape(ball)
    assert run(["render", str(ball), "-o", str(ball.with_name("film.mp4")), "--seconds", "1"]) == 0
    with av.open(str(ball.with_name("film.mp4"))) as film:
        pictures = [frame.to_ndarray(format="rgb24")[..., 0].astype(float) for frame in film.decode(video=0)]
    for red in (pictures[0], pictures[-1]):
        rows, columns = np.nonzero(red > 128)
        assert (rows.mean(), columns.mean()) == pytest.approx((23.5, 31.5), abs=1)


def test_the_cameras_of_a_file_are_not_squashed_into_the_shape_of_the_first(
    ball: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    give_portrait_and_landscape(ball)
    file, film = ball.with_name("given.json"), ball.with_name("film.mp4")
    (ball.with_suffix("") / "cameras.json").rename(file)
    command = ["render", str(ball), "--cameras", str(file), "-o"]
    assert run([*command, str(film)]) == ExitCode.BAD_INPUT
    assert "several shapes" in capsys.readouterr().err
    assert not film.exists()
    assert run([*command, str(ball.with_name("frames"))]) == 0
    assert run([*command, str(film), "--seconds", "0.2"]) == 0


@pytest.mark.parametrize("size", ["64x48", "960x720"])
def test_a_film_has_the_colours_of_the_scene(ball: Path, size: str) -> None:
    film = ball.with_name("film.mp4")
    give_cameras(ball, ("left.jpg", "right.jpg"))
    options = ["--seconds", "0.1", "--size", size, "--background", "0.1,0.9,0.2"]
    assert run(["render", str(ball), "-o", str(film), "-q", *options]) == 0
    with av.open(str(film)) as opened:
        frame = next(opened.decode(video=0))
        codec = opened.streams.video[0].codec_context
        stated = codec.colorspace, codec.color_primaries, codec.color_trc, codec.color_range
    assert stated == (BT709, BT709, BT709, LIMITED)
    background = frame.to_ndarray(format="rgb24", src_colorspace=BT709)[2:8, 2:8].reshape(-1, 3).mean(0)
    assert background == pytest.approx([25.5, 229.5, 51], abs=4)


def test_a_film_of_one_camera_is_an_orbit(ball: Path) -> None:
    give_cameras(ball, ("left.jpg",))
    film = ball.parent / "film.mp4"
    assert run(["render", str(ball), "-o", str(film), "--size", "40x30", "--seconds", "1", "-q"]) == 0
    with av.open(str(film)) as opened:
        pictures = [frame.to_ndarray(format="rgb24").astype(float) for frame in opened.decode(video=0)]
    assert len(pictures) == 30


def test_an_orbit_takes_the_lens_of_the_inputs(ball: Path) -> None:
    give_cameras(ball, ("left.jpg", "right.jpg"))
    out = ball.parent / "orbit"
    assert run(["render", str(ball), "-o", str(out), "--cameras", "orbit", "--frames", "3", "-q"]) == 0
    frames = [cv2.imread(str(path)) for path in sorted(out.glob("*.png"))]
    assert [frame.shape for frame in frames] == [(*SIZE, 3)] * 3
    assert all(frame[SIZE[0] // 2, SIZE[1] // 2, 2] > 200 for frame in frames)


OTHER_OUTPUTS = "film.mov", "film.m4v", "film.3gp", "1.webp", "1.bmp", "1.gif", "a.sog", "cameras.json"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--cameras", "inputs"], "no cameras there"),
        (["--cameras", "nowhere.json"], "no cameras there"),
        (["-o", "film.mp4", "--depth"], "not films"),
        (["-o", "film.mp4", "--size", "3x1"], "at least 2 pixels"),
        (["-o", "film.mp4", "--size", "64x16386", "--frames", "1"], "at most 16,384"),
        (["-o", "film.mp4", "--frames", "5", "--seconds", "1"], "Leave one of them out"),
        *((["-o", name], "films into an .mp4") for name in OTHER_OUTPUTS),
        (["--cameras", ""], "no cameras there"),
        (["-o", "frames", "--seconds", "2"], "is for films"),
        (["--size", "70000x2"], "not a size"),
        (["--size", "12"], "not a size"),
        (["--background", "red"], "not a colour"),
    ],
)
def test_what_cannot_be_rendered(
    options: list[str], said: str, ball: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ball.parent)
    assert run(["render", str(ball), *options]) == ExitCode.BAD_INPUT
    assert said in capsys.readouterr().err
    assert [path.name for path in ball.parent.iterdir()] == ["ball.ply"]


@pytest.mark.parametrize("output", ["film.mp4", "frames"])
def test_frames_of_an_orbit_are_refused_where_the_input_cameras_are_rendered(
    ball: Path, output: str, capsys: pytest.CaptureFixture[str]
) -> None:
    give_cameras(ball, ("left.jpg", "right.jpg"))
    command = ["render", str(ball), "-o", str(ball.parent / output), "--size", "40x30", "-q"]
    assert run([*command, "--frames", "5"]) == ExitCode.BAD_INPUT
    assert "--frames is for orbits" in capsys.readouterr().err
    assert run([*command, "--cameras", "orbit", "--frames", "5"]) == ExitCode.DONE


@pytest.mark.parametrize("size", [None, "128x96"])
def test_the_cameras_of_the_pictures_are_written_beside_them(ball: Path, size: str | None) -> None:
    """Rendered again from these cameras, the pictures are the same. So they can be photos of another scene."""
    give_cameras(ball, ("left.jpg", "right.jpg"))
    first, again = ball.parent / "first", ball.parent / "again"
    options = ["--size", size] if size else []
    assert run(["render", str(ball), "-o", str(first), "-q", *options]) == 0
    cameras = read_known_cameras(first)
    assert list(cameras) == ["left.png", "right.png"]
    assert {(camera.height, camera.width) for camera in cameras.values()} == {(96, 128) if size else SIZE}
    assert run(["render", str(ball), "-o", str(again), "--cameras", str(first / "cameras.json"), "-q"]) == 0
    for name in cameras:
        one, other = (cv2.imread(str(folder / name)).astype(int) for folder in (first, again))
        assert one.shape == other.shape
        assert np.abs(one - other).max() <= 1


@pytest.mark.parametrize("verb", ["render", "inspect"])
@pytest.mark.parametrize("output", ["ball", "."])
def test_the_scene_that_is_read_is_never_replaced(
    ball: Path, capsys: pytest.CaptureFixture[str], verb: str, output: str
) -> None:
    """Neither the scene's folder nor the folder that holds it, also with --force."""
    give_cameras(ball, ("left.jpg",))
    before = sorted(ball.parent.rglob("*"))
    scene = str(ball.with_suffix(""))
    assert run([verb, scene, "-o", str(ball.parent / output), "--force"]) == ExitCode.BAD_INPUT
    assert "would replace" in capsys.readouterr().err
    assert sorted(ball.parent.rglob("*")) == before
