"""The focal length from which structure from motion of many photos starts."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic import FOCAL, WIDTH, arc, photographs, room

from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.start_focals import calibrate_start
from querysplat_cli.scene.views import Photo


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return photographs(room(), arc(6))


def focals(photos: list[Photo]) -> tuple[float, float]:
    """The lens's focal length in longer sides, before and after."""
    with matched(photos, seed=0, progress=lambda text, fraction: None) as matches:
        found = [_focal(matches.database)]
        calibrate_start(matches.database, matches.folder, seed=0)
        return found[0], _focal(matches.database)


def _focal(database: Path) -> float:
    with pycolmap.Database.open(database) as store:
        (camera,) = store.read_all_cameras()
        return float(camera.focal_length) / camera.width


def test_fundamental_matrices_say_where_to_start(photos: list[Photo]) -> None:
    before, after = focals(photos)
    assert before == CAMERA_POLICY.assumed_focal
    assert after == pytest.approx(FOCAL / WIDTH, rel=0.1)
    assert before > 1.2 * FOCAL / WIDTH


def test_what_exif_states_is_kept(photos: list[Photo]) -> None:
    stated = [Photo(photo.name, photo.path, photo.pixels, 1.1 * photo.width) for photo in photos]
    assert focals(stated) == pytest.approx((1.1, 1.1))


def test_photos_that_nothing_relates_keep_the_first_guess() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (6, 120, 160, 3), np.uint8)
    before, after = focals([Photo(f"{i}", Path(f"{i}"), pixels) for i, pixels in enumerate(noise)])
    assert before == after
