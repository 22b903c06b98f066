"""Which photo a given camera belongs to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.match_cameras import cameras_of
from querysplat_cli.scene.photo_names import short_names


def matched(photos: list[str], files: list[str]) -> dict[str, str]:
    """The files of the cameras that photos at these paths have, by path."""
    camera = PhotoCamera.pinhole(np.eye(4), np.diag([100.0, 100.0, 1.0]), 100, 120)
    names = dict(zip(short_names([Path(photo) for photo in photos]), photos, strict=True))
    given = {str(number): replace(camera, file=file) for number, file in enumerate(files)}
    found = cameras_of({name: Path(path) for name, path in names.items()}, given)
    return {names[name]: camera.file for name, camera in found.items()}


@pytest.mark.parametrize(
    ("photos", "files", "expected"),
    [
        (["/s/images/1.jpg", "/s/images/2.jpg"], ["images/2.jpg", "images/1.jpg"], [1, 0]),
        (["/s/images_4/1.jpg", "/s/images_4/2.jpg"], ["/home/ann/images/1.jpg", "../images/2.jpg"], [0, 1]),
        (["/s/all/1.jpg", "/s/all/2.jpg"], ["cam1/1.jpg", "cam2/2.jpg"], [0, 1]),
        (["/s/train/r_0.png", "/s/train/r_1.5.png"], ["./train/r_0", "./train/r_1.5"], [0, 1]),
        (["/s/1.png", "/s/1.jpg"], ["1.jpg"], [None, 0]),
        (["/s/cam1/1.jpg", "/s/cam2/1.jpg"], ["cam2/1.jpg"], [None, 0]),
        (["/s/images/1.jpg"], ["cam1/1.jpg", "cam2/1.jpg"], [None]),
        (["/s/a/1.jpg", "/s/b/1.jpg"], ["1.jpg"], [None, None]),
    ],
    ids=["folder", "other folder", "one folder", "no suffix", "exact", "some", "two cameras", "two photos"],
)
def test_paths_are_compared_from_their_ends(photos: list[str], files: list[str], expected: list[int | None]) -> None:
    wanted = {photo: files[number] for photo, number in zip(photos, expected, strict=True) if number is not None}
    assert matched(photos, files) == wanted


def test_no_photo_gets_the_camera_of_a_photo_in_another_folder() -> None:
    photos = [f"/s/images/cam2/{number}.jpg" for number in (1, 2, 3)]
    assert matched(photos, ["cam1/1.jpg", "cam1/2.jpg", "cam2/3.jpg"]) == {photos[2]: "cam2/3.jpg"}
    assert matched(["/s/cam1/5.jpg", "/s/cam3/1.jpg"], ["cam1/1.jpg", "cam1/5.jpg"]) == {"/s/cam1/5.jpg": "cam1/5.jpg"}
