"""Cameras in LLFF's poses_bounds.npy."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.colmap import write_colmap
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.gaussians import Gaussians

NAMES = ("IMG_10.JPG", "IMG_2.JPG", "b.png")
"""As LLFF sorts them, and people do not."""


def given() -> dict[str, PhotoCamera]:
    """Cameras of 160 × 120 photos, each turned and at a place of its own."""
    found = {}
    for number, name in enumerate(NAMES):
        w2c = np.eye(4)
        w2c[:3, :3] = cv2.Rodrigues(np.array([0.3, -0.2 * number, 0.5]))[0]
        w2c[:3, 3] = [number, 0.5, 2.0 + number**2]
        found[name] = PhotoCamera(w2c, (140.0, 140.0), (80.0, 60.0), (0.0, 0.0, 0.0, 0.0), 120, 160)
    return found


def llff(folder: Path, cameras: dict[str, PhotoCamera], pictures: str = "images") -> np.ndarray:
    """Write the photos, and give the array for their cameras in the words of LLFF's own description."""
    rows = []
    for name, camera in cameras.items():
        (folder / pictures).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / pictures / name), np.full((camera.height, camera.width, 3), 99, np.uint8))
        right, down, forward = camera.w2c[:3, :3]
        centre = -camera.w2c[:3, :3].T @ camera.w2c[:3, 3]
        size = np.array([camera.height, camera.width, camera.focal[0]])
        matrix = np.stack([down, right, -forward, centre, size], 1)
        rows.append([*matrix.ravel(), 0.5, 9.0])
    return np.array(rows)


@pytest.mark.parametrize("pictures", ["images", "images_4", "."])
def test_known_cameras_are_read(tmp_path: Path, pictures: str) -> None:
    """By the file, and by its folder."""
    np.save(tmp_path / "poses_bounds.npy", llff(tmp_path, given(), pictures))
    (tmp_path / pictures / "._IMG_10.JPG").write_bytes(b"a note of macOS")
    for place in (tmp_path, tmp_path / "poses_bounds.npy"):
        found = read_known_cameras(place)
        assert list(found) == list(NAMES)
        for name, camera in given().items():
            np.testing.assert_allclose(found[name].w2c, camera.w2c, atol=1e-12)
            assert found[name].K.tolist() == camera.K.tolist()
            assert (found[name].height, found[name].width, found[name].as_stored) == (120, 160, True)
            assert found[name].file == (name if pictures == "." else f"{pictures}/{name}")


def test_axes_by_hand(tmp_path: Path) -> None:
    """A camera 5 above a table, looking down on it, with the top of its picture towards y."""
    flat = PhotoCamera(np.eye(4), (140.0, 140.0), (80.0, 60.0), (0.0, 0.0, 0.0, 0.0), 120, 160)
    row = llff(tmp_path, {"a.png": flat})
    down, right, backward, centre = [0, -1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 5]
    row[0, :15] = np.stack([down, right, backward, centre, [120, 160, 140]], 1).ravel()
    np.save(tmp_path / "poses_bounds.npy", row.astype(np.float32))
    (camera,) = read_known_cameras(tmp_path).values()
    np.testing.assert_allclose(camera.w2c @ [1, 2, 0, 1], [1, -2, 5, 1])


def test_cameras_are_converted_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a" / "poses_bounds.npy", llff(tmp_path / "a", given()))
    write_transforms(tmp_path / "true.json", given())
    for target in ("b.json", "model"):
        assert run(["convert", str(tmp_path / "a"), str(tmp_path / target), "-q"]) == 0
        assert run(["poses", str(tmp_path / target), str(tmp_path / "true.json"), "--json", "-q"]) == 0
        assert json.loads(capsys.readouterr().out)["rotation_degrees"]["max"] < 1e-3
    assert run(["convert", str(tmp_path / "a"), str(tmp_path / "s"), "--photos", str(tmp_path / "a"), "-q"]) == 0
    assert len(list((tmp_path / "s" / "images").iterdir())) == len(NAMES)


@pytest.mark.parametrize("packed", [False, True])
def test_a_captured_scene_has_its_cameras(tmp_path: Path, packed: bool) -> None:
    """As `eval` and `train` read it, from a folder or a zip."""
    np.save(tmp_path / "fern" / "poses_bounds.npy", llff(tmp_path / "fern", given()))
    place = Path(shutil.make_archive(str(tmp_path / "fern"), "zip", tmp_path / "fern")) if packed else tmp_path / "fern"
    (scene,) = find_scenes([place], "images")
    assert scene.notes == ()
    assert {frame.name for frame in scene.frames} == scene.cameras.keys() == set(NAMES)
    for name, camera in given().items():
        np.testing.assert_allclose(scene.cameras[name].w2c, camera.w2c, atol=1e-12)


def test_smaller_copies_of_other_names_are_passed_over(tmp_path: Path) -> None:
    """As in LLFF's own scenes, whose images_4 has image000.png where images has IMG_4026.JPG."""
    np.save(tmp_path / "poses_bounds.npy", llff(tmp_path, given()))
    (tmp_path / "images_4").mkdir()
    cv2.imwrite(str(tmp_path / "images_4" / "image000.png"), np.zeros((30, 40, 3), np.uint8))
    (scene,) = find_scenes([tmp_path])
    assert {frame.folder for frame in scene.frames} == {"images"}
    assert scene.notes == ("none of the listed pictures in images_4: its pictures are those of images",)


@pytest.mark.parametrize("cameras", ["a/poses_bounds.npy", "a", "model", "model/images.bin"])
def test_cameras_to_render(tmp_path: Path, cameras: str) -> None:
    """LLFF's and COLMAP's, by their files and folders."""
    np.save(tmp_path / "a" / "poses_bounds.npy", llff(tmp_path / "a", given()))
    (tmp_path / "model").mkdir()
    write_colmap(tmp_path / "model", given())
    means, sh = torch.rand(3, 3), torch.zeros(3, 1, 3)
    write_ply(tmp_path / "scene.ply", Gaussians(means, torch.rand(3, 4), torch.ones(3, 3), torch.ones(3) / 2, sh))
    out = tmp_path / "frames"
    assert run(["render", str(tmp_path / "scene.ply"), "-o", str(out), "--cameras", str(tmp_path / cameras), "-q"]) == 0
    written = read_known_cameras(out / "cameras.json")
    assert list(written) == [f"{Path(name).stem}.png" for name in NAMES]
    for camera, rendered in zip(given().values(), written.values(), strict=True):
        np.testing.assert_allclose(rendered.w2c, camera.w2c, atol=1e-5)
        assert rendered.K.tolist() == camera.K.tolist()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[:2], "has 2 cameras, and .*images has 3 photos"),
        (lambda rows: rows[:, :15], "no cameras in it .3 × 15 of float64"),
        (lambda rows: rows[0], "no cameras in it .17 of float64"),
        (lambda rows: rows.astype(complex), "no cameras in it .3 × 17 of complex128"),
        (lambda rows: np.where(rows == 140, np.nan, rows), "IMG_10.JPG makes no sense: its focal length is nan"),
        (lambda rows: np.where(rows == 120, np.nan, rows), "IMG_10.JPG makes no sense: "),
        (lambda rows: np.where(rows == 120, 119.5, rows), "IMG_10.JPG makes no sense: h is 119.5, no whole number"),
    ],
)
def test_other_arrays_are_refused(tmp_path: Path, change, said: str) -> None:  # type: ignore[no-untyped-def]
    np.save(tmp_path / "poses_bounds.npy", change(llff(tmp_path, given())))
    with pytest.raises(QuerySplatError, match=said):
        read_known_cameras(tmp_path)


def test_files_that_are_no_arrays_of_numbers_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pickled objects could run a program. A header may state more numbers than any memory holds."""
    rows, file = llff(tmp_path, given()), tmp_path / "poses_bounds.npy"
    np.save(file, rows)
    whole = file.read_bytes()
    np.save(file, np.array([{"a": 1}, None], object), allow_pickle=True)
    huge = whole.replace(b"(3, 17)", b"(3" + b"0" * 12 + b", 17)").replace(b" " * 12 + b"\n", b"\n")
    for content in (file.read_bytes(), huge, whole[:-1], whole[:20], b"", b"PK\x03\x04", b"text"):
        file.write_bytes(content)
        assert run(["poses", str(file), str(file)]) == ExitCode.BAD_INPUT
        assert "cannot be read as an array of numbers" in capsys.readouterr().err


def test_a_matrix_that_turns_nothing_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = llff(tmp_path, given())
    rows[1, :3] *= 2
    np.save(tmp_path / "poses_bounds.npy", rows)
    assert run(["poses", str(tmp_path), str(tmp_path)]) == ExitCode.BAD_INPUT
    assert "the camera of 'IMG_2.JPG' is no rigid motion" in capsys.readouterr().err
