"""The pictures of a dataset whose names are not quite those that its list of cameras has."""

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.known import read_known_cameras


def write_scene(home: Path, listed: list[str], pictures: list[str]) -> None:
    frames = [{"file_path": path, "transform_matrix": np.eye(4).tolist()} for path in listed]
    home.mkdir(parents=True)
    (home / "transforms.json").write_text(json.dumps({"w": 64, "h": 48, "fl_x": 50, "frames": frames}))
    for picture in pictures:
        (home / picture).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(home / picture), np.zeros((48, 64, 3), np.uint8))


@pytest.mark.parametrize("listed", [".jpg", ".JPG", ".png", ""])
@pytest.mark.parametrize("there", [".png", ".PNG"])
def test_pictures_may_have_another_suffix_than_the_listed_ones(tmp_path: Path, listed: str, there: str) -> None:
    """Smaller copies are often PNG files where the list has JPEG, and `--poses` matches them as well."""
    write_scene(tmp_path / "scene1", [f"images/a{listed}", f"images/b{listed}"], [f"images_4/{n}{there}" for n in "ab"])
    (scene,) = find_scenes([tmp_path])
    assert [frame.file for frame in scene.frames] == [tmp_path / "scene1" / "images_4" / f"{n}{there}" for n in "ab"]
    assert all(frame.name in scene.cameras for frame in scene.frames)
    assert scene.notes == ()


def test_a_folder_with_other_names_is_passed_over(tmp_path: Path) -> None:
    """As in LLFF's scenes, whose images_4 has image000.png where images has IMG_4026.JPG."""
    write_scene(tmp_path / "fern", ["IMG_4026.JPG"], ["images/IMG_4026.jpg", "images_4/image000.png"])
    (scene,) = find_scenes([tmp_path])
    assert [frame.folder for frame in scene.frames] == ["images"]
    assert scene.notes == ("none of the listed pictures in images_4: its pictures are those of images",)


def test_a_list_without_sizes_has_those_of_the_photos_that_are_given_with_it(tmp_path: Path) -> None:
    """Wherever its pictures lie. Where two photos have the name of one and are not of one size, it has none."""
    frames = [{"file_path": f"./train/{name}", "transform_matrix": np.eye(4).tolist()} for name in ("r_0", "r_1.png")]
    (tmp_path / "cameras").mkdir()
    listing = tmp_path / "cameras" / "transforms.json"
    listing.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    photos = [tmp_path / name for name in ("r_0.png", "r_1.jpg", "other.png")]
    for number, photo in enumerate(photos):
        cv2.imwrite(str(photo), np.zeros((240, 320 + number, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="r_0 has no 'w'"):
        read_known_cameras(listing)
    found = read_known_cameras(listing, photos=photos)
    assert [(camera.height, camera.width) for camera in found.values()] == [(240, 320), (240, 321)]
    assert run(["convert", str(listing), str(tmp_path / "scene"), "--photos", str(tmp_path), "-q"]) == 0
    cv2.imwrite(str(tmp_path / "cameras" / "r_0.png"), np.zeros((24, 64, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="r_0 has no 'w'"):
        read_known_cameras(listing, photos=[*photos, tmp_path / "cameras" / "r_0.png"])


def test_the_photos_are_looked_through_once_for_all_frames(tmp_path: Path) -> None:
    """Once for each frame takes 2,000 photos 23 seconds."""

    class Counted(list[Path]):
        times = 0

        def __iter__(self) -> Iterator[Path]:
            self.times += 1
            return super().__iter__()

    frames = [{"file_path": f"r_{i}", "fl_x": 50, "transform_matrix": np.eye(4).tolist()} for i in range(5)]
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "transforms.json").write_text(json.dumps({"frames": frames}))
    photos = Counted(tmp_path / f"r_{i}.png" for i in range(5))
    for photo in list(photos):
        cv2.imwrite(str(photo), np.zeros((48, 64, 3), np.uint8))
    photos.times = 0
    assert len(read_known_cameras(tmp_path / "cameras" / "transforms.json", photos=photos)) == 5
    assert photos.times == 1
