"""COLMAP's models, written by pycolmap itself."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.colmap import copy_colmap, write_colmap
from querysplat_cli.scene.formats.colmap_files import check_binary
from querysplat_cli.scene.formats.known import read_known_cameras

POSES = [
    np.hstack([rotation.as_matrix(), [[i], [2], [3]]]) for i, rotation in enumerate(Rotation.random(3, random_state=0))
]
NAMES = ("left/1.jpg", "right/1.jpg", "right/2.jpg")


def write_model(folder: Path, lens: str, parameters: list[float], *, text: bool = False, seen: bool = False) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=lens, width=640, height=480, params=parameters, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for number, (pose, name) in enumerate(zip(POSES, NAMES, strict=True), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        if seen:
            image.points2D = [pycolmap.Point2D(np.array(pixel)) for pixel in ([2.0, 3.0], [7.0, 8.0])]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    if seen:
        model.add_point3D(np.array([5.0, 6.0, 7.0]), pycolmap.Track([pycolmap.TrackElement(1, 0)]))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(folder)


@pytest.mark.parametrize(
    ("lens", "parameters", "focal", "distortion"),
    [
        ("SIMPLE_PINHOLE", [500, 320, 240], (500, 500), (0, 0, 0, 0)),
        ("PINHOLE", [500, 510, 320, 240], (500, 510), (0, 0, 0, 0)),
        ("SIMPLE_RADIAL", [500, 320, 240, 0.1], (500, 500), (0.1, 0, 0, 0)),
        ("RADIAL", [500, 320, 240, 0.1, -0.2], (500, 500), (0.1, -0.2, 0, 0)),
        ("OPENCV", [500, 510, 320, 240, 0.1, -0.2, 0.01, 0.02], (500, 510), (0.1, -0.2, 0.01, 0.02)),
        ("FULL_OPENCV", [500, 510, 320, 240, 0.1, -0.2, 0.01, 0.02, 0, 0, 0, 0], (500, 510), (0.1, -0.2, 0.01, 0.02)),
    ],
)
@pytest.mark.parametrize("text", [False, True])
def test_cameras_come_back(
    tmp_path: Path,
    lens: str,
    parameters: list[float],
    focal: tuple[float, float],
    distortion: tuple[float, ...],
    text: bool,
) -> None:
    write_model(tmp_path / "sparse" / "0", lens, parameters, text=text)
    found = read_known_cameras(tmp_path)
    assert list(found) == ["left/1.jpg", "right/1.jpg", "2.jpg"]
    for camera, pose in zip(found.values(), POSES, strict=True):
        np.testing.assert_allclose(camera.w2c[:3], pose, atol=1e-12)
        assert (camera.focal, camera.principal, camera.distortion) == (focal, (320, 240), distortion)
        assert (camera.height, camera.width) == (480, 640)
    assert read_known_cameras(tmp_path / "sparse" / "0" / f"images.{'txt' if text else 'bin'}").keys() == found.keys()


@pytest.mark.parametrize("text", [False, True])
def test_a_model_without_points_has_its_cameras(tmp_path: Path, text: bool) -> None:
    """COLMAP reads none without the file, and said that all files were missing."""
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=text)
    for part in ("points3D", "rigs", "frames"):
        (tmp_path / f"{part}.{'txt' if text else 'bin'}").unlink()
    assert len(read_known_cameras(tmp_path)) == len(NAMES)


def test_other_lenses_are_refused_by_name(tmp_path: Path) -> None:
    write_model(tmp_path, "OPENCV_FISHEYE", [500, 500, 320, 240, 0.1, 0, 0, 0])
    with pytest.raises(QuerySplatError, match="OPENCV_FISHEYE") as caught:
        read_known_cameras(tmp_path)
    assert "image_undistorter" in caught.value.hint
    write_model(tmp_path, "FULL_OPENCV", [500, 510, 320, 240, 0.1, -0.2, 0.01, 0.02, 0, 0, 0, 1e-3])
    with pytest.raises(QuerySplatError, match="FULL_OPENCV"):
        read_known_cameras(tmp_path)


def test_damaged_models_are_refused(tmp_path: Path) -> None:
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240])
    (tmp_path / "images.bin").write_bytes((tmp_path / "images.bin").read_bytes()[:50])
    with pytest.raises(QuerySplatError, match="no COLMAP model that can be read"):
        read_known_cameras(tmp_path)
    for file in tmp_path.glob("cameras.*"):
        file.unlink()
    with pytest.raises(QuerySplatError, match=r"no COLMAP model that can be read: cameras\.bin is missing"):
        read_known_cameras(tmp_path)


@pytest.mark.parametrize(
    ("name", "whole", "damaged"),
    [
        ("cameras", "500 510 320 240", "500 51"),
        ("cameras", "500 510 320 240", "500 51O 320 240"),
        ("cameras", "1 PINHOLE", "1 PIN"),
        ("images", " 1 left/1.jpg", ""),
        ("images", "1 2 3 1 right/1.jpg", "1 x 3 1 right/1.jpg"),
        ("images", "7 8 -1", "7 8"),
        ("images", "7 8 -1", "7 8 x"),
        ("points3D", "1 5 6 7 0 0 0 -1 1 0", "1 5 6"),
        ("points3D", "1 5 6 7", "one 5 6 7"),
        ("rigs", "1 1 CAMERA 1", "1 1 CAMERA"),
        ("rigs", "1 1 CAMERA 1", "1 x CAMERA 1"),
        ("frames", "1 CAMERA 1 1", "1 CAMERA 1"),
        ("frames", "1 CAMERA 1 1", "x CAMERA 1 1"),
    ],
)
def test_damaged_text_is_refused_by_its_file_and_line(
    tmp_path: Path, name: str, whole: str, damaged: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """The message was that of a check in COLMAP's code."""
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=True, seen=True)
    assert len(read_known_cameras(tmp_path)) == len(NAMES)
    file = tmp_path / f"{name}.txt"
    lines = file.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if whole in line and not line.startswith("#"))
    lines[number] = lines[number].replace(whole, damaged)
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(QuerySplatError) as caught:
        read_known_cameras(tmp_path)
    reason = f"line {number + 1} of {name}.txt is damaged, or cut off"
    assert caught.value.message == f"{tmp_path}: no COLMAP model that can be read: {reason}"
    assert not capfd.readouterr().err


@pytest.mark.parametrize("name", ["cameras", "images", "rigs", "frames"])
def test_text_that_is_cut_off_in_its_first_lines_is_refused_by_its_file(tmp_path: Path, name: str) -> None:
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=True, seen=True)
    file = tmp_path / f"{name}.txt"
    file.write_text(file.read_text()[:60])
    with pytest.raises(QuerySplatError, match=rf"can be read: {name}\.txt is empty, or cut off$"):
        read_known_cameras(tmp_path)


def test_files_of_several_models_are_refused_in_words(tmp_path: Path) -> None:
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=True)
    frames = tmp_path / "frames.txt"
    frames.write_text(frames.read_text().replace("CAMERA 1 3", "CAMERA 1 4"))
    with pytest.raises(QuerySplatError, match=r"can be read: its files do not fit each other$"):
        read_known_cameras(tmp_path)


def test_points_and_rigs_are_no_damage(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera(model="FOV", width=640, height=480, params=[500, 500, 320, 240, 0.1], camera_id=number)
        model.add_camera_with_trivial_rig(camera)
    for number, (pose, name) in enumerate(zip(POSES, NAMES, strict=True), start=1):
        points = [pycolmap.Point2D(np.array([i, i])) for i in range(number)]
        image = pycolmap.Image(name=name, points2D=points, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for i in range(3):
        model.add_point3D(np.ones(3) * i, pycolmap.Track([pycolmap.TrackElement(3, i)]))
    model.write_binary(tmp_path)
    check_binary(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_absurd_counts_are_refused_without_their_memory(tmp_path: Path, name: str) -> None:
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240])
    file = tmp_path / f"{name}.bin"
    whole = file.read_bytes()
    for damaged in (b"\xff" * 7 + b"\x00" + whole[8:], whole[:-1], b""):
        file.write_bytes(damaged)
        with pytest.raises(QuerySplatError, match=f"{name}.bin is damaged"):
            read_known_cameras(tmp_path)
    file.write_bytes(whole)
    assert len(read_known_cameras(tmp_path)) == 3


def test_text_cannot_hold_names_with_spaces(tmp_path: Path) -> None:
    """COLMAP's reader cuts them at the first space, so that seven photos became one."""
    cameras = {
        f"my photo {i}.jpg": PhotoCamera(
            np.vstack([pose, [0, 0, 0, 1]]), (500.0, 500.0), (320.0, 240.0), (0.0, 0.0, 0.0, 0.0), 480, 640
        )
        for i, pose in enumerate(POSES)
    }
    (tmp_path / "binary").mkdir()
    write_colmap(tmp_path / "binary", cameras)
    assert list(read_known_cameras(tmp_path / "binary")) == list(cameras)
    (tmp_path / "text").mkdir()
    with pytest.raises(QuerySplatError, match=r"space in 'my photo 0\.jpg'"):
        write_colmap(tmp_path / "text", cameras, text=True)
    with pytest.raises(QuerySplatError, match="cannot hold the space"):
        copy_colmap(tmp_path / "binary", tmp_path / "text", text=True)
    assert not list((tmp_path / "text").iterdir())
    pycolmap.Reconstruction(tmp_path / "binary").write_text(tmp_path / "text")
    with pytest.raises(QuerySplatError, match=r"cuts the name 'my photo \d.jpg' in images.txt"):
        read_known_cameras(tmp_path / "text")


def test_a_last_photo_without_its_second_line_is_not_lost_silently(tmp_path: Path) -> None:
    """COLMAP reads such a model without it."""
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=True)
    images = tmp_path / "images.txt"
    images.write_text(images.read_text().rstrip("\n") + "\n")
    assert len(pycolmap.Reconstruction(tmp_path).images) == 2
    with pytest.raises(QuerySplatError, match=r"ends at 'right/2\.jpg', and COLMAP leaves that photo out"):
        read_known_cameras(tmp_path)
    images.write_text(images.read_text() + "\n")
    assert len(read_known_cameras(tmp_path)) == 3


def test_photos_without_second_lines_are_refused_with_what_to_do(tmp_path: Path) -> None:
    """Programs and editors drop empty lines. COLMAP failed at a number, or left every other photo out."""
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240], text=True)
    images = tmp_path / "images.txt"
    images.write_text("".join(line for line in images.read_text().splitlines(True) if line.strip()) + "\n")
    with pytest.raises(QuerySplatError, match=r"the line after that of 'left/1\.jpg' in images\.txt has no points"):
        read_known_cameras(tmp_path)


@pytest.mark.parametrize("name", ["cameras.xml", "scene.splat"])
def test_a_file_of_another_program_does_not_stand_for_its_folder(tmp_path: Path, name: str) -> None:
    write_model(tmp_path, "PINHOLE", [500, 510, 320, 240])
    (tmp_path / name).touch()
    with pytest.raises(QuerySplatError, match=f"{name}: not a kind of file"):
        read_known_cameras(tmp_path / name)
