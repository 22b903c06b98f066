"""Camera errors with known answers."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from querysplat_cli.commands.poses import compare
from querysplat_cli.commands.requests import PosesRequest
from querysplat_cli.evaluation.poses import area_under_recall, compare_cameras, draw_trajectories
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.formats.transforms_frame import opengl_from_opencv
from querysplat_cli.scene.lenses import pinhole_photos
from querysplat_cli.scene.sim3 import DegenerateAlignment
from querysplat_cli.scene.views import Photo


def track(count: int = 8) -> dict[str, PhotoCamera]:
    """Cameras on a bent line, turned at random."""
    turns = Rotation.random(count, random_state=1).as_matrix()
    cameras = {}
    for i, turn in enumerate(turns):
        w2c = np.eye(4)
        w2c[:3, :3] = turn
        w2c[:3, 3] = -turn @ [1.0 * i, 0.1 * i * i, np.sin(i)]
        cameras[f"photo_{i}.jpg"] = PhotoCamera(w2c, (500.0, 500.0), (320.0, 240.0), (0.0, 0.0, 0.0, 0.0), 480, 640)
    return cameras


def moved(cameras: dict[str, PhotoCamera], scale: float) -> dict[str, PhotoCamera]:
    """The same cameras in a rotated, scaled and shifted world, under other file names."""
    turn = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    result = {}
    for name, camera in cameras.items():
        w2c = np.eye(4)
        w2c[:3, :3] = camera.w2c[:3, :3] @ turn.T
        w2c[:3, 3] = scale * camera.w2c[:3, 3] - w2c[:3, :3] @ [3, 4, -5]
        result[f"folder/{Path(name).stem}.png"] = replace(camera, w2c=w2c)
    return result


def test_a_similarity_is_no_error() -> None:
    errors = compare_cameras(moved(track(), 2.5), track())
    assert errors.scale == pytest.approx(1 / 2.5)
    for part in (errors.rotation, errors.centre, errors.pair_rotation, errors.pair_translation, errors.focal):
        assert np.abs(part).max() < 1e-6
    summary = errors.summary()
    assert summary["photos"] == 8
    assert all(
        summary[f"{rate}_{t}"] == pytest.approx(100, abs=1e-4) for rate in ("rra", "rta", "auc") for t in (5, 30)
    )


def test_photos_of_one_name_in_two_folders_are_not_mixed_up() -> None:
    both = {f"cam{number % 2}/{number // 2}.jpg": camera for number, camera in enumerate(track().values())}
    backwards = {f"images/{name}": both[name] for name in reversed(both)}
    errors = compare_cameras(backwards, both)
    assert len(errors.names) == 8
    assert errors.ate < 1e-6


def test_a_turned_camera_is_found() -> None:
    """One of eight cameras is rolled by 10°: 7 of 28 pairs have that rotation error, and a direction error, too."""
    cameras = track()
    name = "photo_0.jpg"
    w2c = np.eye(4)
    w2c[:3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    cameras[name] = replace(cameras[name], w2c=w2c @ cameras[name].w2c)
    errors = compare_cameras(cameras, track())
    assert (errors.pair_rotation > 9.999).sum() == 7
    assert np.sort(errors.pair_rotation)[-8:] == pytest.approx([0, *[10] * 7], abs=1e-4)
    # The alignment's rotation is the mean of the relative rotations, so it takes up some of the ten degrees.
    assert errors.rotation[0] == pytest.approx(10, abs=2)
    assert errors.rotation[0] == errors.rotation.max()
    summary = errors.summary()
    assert summary["rra_5"] == pytest.approx(100 * 21 / 28)
    assert summary["rra_15"] == 100


def test_ate_is_after_the_least_squares_similarity_of_the_centres() -> None:
    """Orientations have no part in it: cameras that are all turned alike about their own centres have none."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 1, degrees=True).as_matrix()
    turned = {name: replace(camera, w2c=turn @ camera.w2c) for name, camera in moved(track(), 2.5).items()}
    errors = compare_cameras(turned, track())
    assert errors.ate < 1e-6
    assert errors.rotation.max() > 0.1
    noise = np.random.default_rng(0).normal(0, 0.3, (8, 3))
    shaken = {}
    for (name, camera), shift in zip(track().items(), noise, strict=True):
        w2c = camera.w2c.copy()
        w2c[:3, 3] -= w2c[:3, :3] @ shift
        shaken[name] = replace(camera, w2c=w2c)
    a, b = ([-camera.w2c[:3, :3].T @ camera.w2c[:3, 3] for camera in each.values()] for each in (shaken, track()))

    def error(numbers: np.ndarray) -> np.ndarray:
        places = np.exp(numbers[0]) * np.array(a) @ Rotation.from_rotvec(numbers[1:4]).as_matrix().T + numbers[4:]
        return (places - np.array(b)).ravel()

    least = least_squares(error, np.zeros(7))
    assert compare_cameras(shaken, track()).ate == pytest.approx(np.sqrt(2 * least.cost / 8), rel=1e-6)


def test_a_shifted_camera_and_a_wrong_lens() -> None:
    cameras = track(30)
    camera = cameras["photo_5.jpg"]
    w2c = camera.w2c.copy()
    w2c[:3, 3] -= w2c[:3, :3] @ [0, 0, 0.5]
    cameras["photo_5.jpg"] = replace(camera, w2c=w2c, focal=(550.0, 550.0))
    errors = compare_cameras(cameras, track(30))
    assert errors.centre.argmax() == 5
    assert errors.centre[5] == pytest.approx(0.5, rel=0.05)
    assert errors.ate == pytest.approx(0.5 / np.sqrt(30), rel=0.05)
    assert errors.focal[5] == pytest.approx(0.1)
    assert np.abs(np.delete(errors.focal, 5)).max() < 1e-12


def test_the_focal_length_counts_in_pictures_not_pixels() -> None:
    half = {
        name: replace(camera, focal=(250.0, 250.0), principal=(160.0, 120.0), height=240, width=320)
        for name, camera in track().items()
    }
    assert np.abs(compare_cameras(half, track()).focal).max() < 1e-12


def test_area_under_recall_is_the_integral() -> None:
    assert area_under_recall(np.array([0.0, 0.0]), 5.0) == 1
    assert area_under_recall(np.array([2.5, 10.0]), 5.0) == 0.25
    errors = np.random.default_rng(0).uniform(0, 40, 200)
    steps = (np.arange(200_000) + 0.5) / 200_000 * 30
    curve = np.searchsorted(np.sort(errors), steps) / len(errors)
    assert area_under_recall(errors, 30.0) == pytest.approx(curve.mean(), abs=1e-4)


def test_names_that_do_not_agree_are_those_of_unpaired_photos() -> None:
    names = list(track())
    with pytest.raises(QuerySplatError, match=r"^1 photo in both") as caught:
        compare_cameras(track(), {names[0]: track()[names[0]], "other.jpg": track()[names[1]]})
    assert caught.value.hint == f"Names must agree: one has {names[1]}, the other other.jpg."


def test_cameras_at_one_place_are_named_on_either_side() -> None:
    standing = {name: replace(camera, w2c=camera.w2c * np.array([1, 1, 1, 0])) for name, camera in track().items()}
    standing = {name: replace(each, w2c=each.w2c + np.diag([0, 0, 0, 1])) for name, each in standing.items()}
    for a, b in ((standing, track()), (track(), standing)):
        with pytest.raises(DegenerateAlignment, match="at one place"):
            compare_cameras(a, b)


def test_what_cannot_be_compared() -> None:
    with pytest.raises(QuerySplatError, match="0 photos in both"):
        compare_cameras(track(), {"other.jpg": track()["photo_0.jpg"]})
    still = {name: replace(camera, w2c=np.eye(4)) for name, camera in track().items()}
    with pytest.raises(DegenerateAlignment):
        compare_cameras(still, track())
    partial = compare_cameras(dict(list(track().items())[:5]), track())
    assert (len(partial.names), len(partial.only_b), partial.only_a) == (5, 3, ())


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_the_picture(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("matplotlib")
    file = tmp_path / f"tracks.{suffix}"
    draw_trajectories(compare_cameras(moved(track(), 2.0), track()), file, ("A", "B"))
    assert file.read_bytes()[:5] == (b"\x89PNG\r" if suffix == "png" else b"<?xml")
    with pytest.raises(QuerySplatError, match="not a kind of picture"):
        draw_trajectories(compare_cameras(track(), track()), tmp_path / "tracks.doc", ("A", "B"))


@pytest.mark.parametrize("wrong", [np.nan, 0.5, -1.0])
def test_a_camera_that_is_no_rigid_motion_is_named(tmp_path: Path, wrong: float) -> None:
    """One that is not a number was a traceback, and the others were compared as if they were cameras."""
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": np.diag([1.0, 1, 1, 1]).tolist()} for i in range(3)]
    lens = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240}
    for name, factor in (("right", 1.0), ("wrong", wrong)):
        frames[1]["transform_matrix"][0][0] = factor
        (tmp_path / f"{name}.json").write_text(json.dumps({**lens, "frames": frames}))
    with pytest.raises(QuerySplatError, match=r"wrong.json: the camera of '.*1.png' is no rigid motion"):
        compare(PosesRequest(tmp_path / "wrong.json", tmp_path / "right.json"), Stages())


@pytest.mark.parametrize("longer", [1.0, 1.01])
def test_fisheye_cameras_are_compared(longer: float, tmp_path: Path) -> None:
    """With each other, and with the pinhole views that `reconstruct` makes of their photos."""
    lens = {"fl_x": 110.0, "fl_y": 112.0, "cx": 158.0, "cy": 121.0, "k1": 0.02, "k2": -0.004, "k3": 0.001, "k4": 0.0}
    files = {}
    for name, factor in (("a", longer), ("b", 1.0)):
        keys = {**lens, "fl_x": factor * lens["fl_x"], "fl_y": factor * lens["fl_y"], "w": 320, "h": 240}
        frames = [
            {"file_path": f"images/{photo}", "transform_matrix": opengl_from_opencv(camera.w2c).tolist()}
            for photo, camera in track(3).items()
        ]
        files[name] = tmp_path / f"{name}.json"
        files[name].write_text(json.dumps({"camera_model": "OPENCV_FISHEYE", **keys, "frames": frames}))
    summary, _ = compare(PosesRequest(files["a"], files["b"]), Stages())
    assert summary["centre"]["max"] < 1e-6
    assert summary["focal_error"]["median"] == pytest.approx(longer - 1, abs=1e-9)
    bent = read_known_cameras(files["b"], fisheye=True)
    photos = [Photo(name, tmp_path / name, np.zeros((240, 320, 3), np.uint8)) for name in bent]
    _, straight = pinhole_photos(photos, bent, "auto")
    assert straight is not None
    write_transforms(tmp_path / "views.json", straight)
    summary, _ = compare(PosesRequest(files["b"], tmp_path / "views.json"), Stages())
    assert summary["focal_error"]["max_abs"] < 0.01  # views have whole numbers of pixels


def test_colmap_gets_pinhole_views_of_fisheye_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = track(3)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl_from_opencv(camera.w2c).tolist()}
        for name, camera in cameras.items()
    ]
    (tmp_path / "images").mkdir()
    for name in cameras:
        Image.new("RGB", (320, 240)).save(tmp_path / "images" / name)
    lens = {"camera_model": "OPENCV_FISHEYE", "w": 320, "h": 240, "fl_x": 110, "fl_y": 110, "cx": 160, "cy": 120}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))

    def colmap(photos: Sequence[Photo], **_: object) -> dict[str, PhotoCamera]:
        views = {photo.name: photo.view for photo in photos if photo.view}
        assert list(views) == list(cameras)
        size = {photo.name: (photo.height, photo.width) for photo in photos}
        K = np.diag([110.0, 110, 1])
        return {name: PhotoCamera.pinhole(cameras[name].w2c, K, *size[name]) for name in views}

    monkeypatch.setattr("querysplat_cli.commands.poses.estimate_with_colmap", colmap)
    summary, _ = compare(PosesRequest(tmp_path, colmap=True), Stages())
    assert summary["photos"] == 3
    assert summary["rotation_degrees"]["max"] < 1e-4
    assert summary["focal_error"]["max_abs"] < 0.01  # views have whole numbers of pixels
