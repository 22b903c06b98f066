"""Three and four photos of a long lens get its focal length, wherever their search starts."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from synthetic import FOCAL, arc, camera, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical import few_focals
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.few_focals import few_placed
from querysplat_cli.encoders.classical.mapping import map_photos
from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.encoders.classical.search import MatcherChoice
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo

LONG = 576.0
"""1.8 longer sides: 31°. The usual focal length is 0.75."""


def far_cameras(*degrees: float) -> list[PhotoCamera]:
    """Cameras with a long lens around the room's boards, far from them."""
    turns = np.radians(degrees)
    return [camera((9 * np.sin(a), -1.4, 4 - 9 * np.cos(a)), (0, 0, 4), focal=LONG) for a in turns]


def long_photos(focal: float | None = None) -> list[Photo]:
    photos = photographs(room(), far_cameras(-40, -5, 35))
    return [replace(photo, focal=focal) for photo in photos]


@pytest.mark.parametrize("degrees", [(-40, -5, 35), (-30, -10, 10, 30)])
def test_a_long_lens_keeps_its_focal_length(degrees: tuple[float, ...]) -> None:
    """From the usual focal length alone, the three photos had 0.4 times theirs."""
    photos = photographs(room(), far_cameras(*degrees))
    posed = estimate_cameras(photos, CameraRequest(320, seed=0), silent, MatcherChoice("sift"))
    assert [found.focal[0] / LONG for found in posed.photo_cameras] == pytest.approx([1.0] * len(degrees), rel=0.02)


def test_the_database_follows_the_cameras() -> None:
    photos = long_photos()
    with matched(photos, seed=0, progress=silent) as matches:
        start = map_photos(matches, photos, seed=0)
        found = few_placed(start, matches, photos, 0)
        assert found is not None
        assert found.mapped is not start
        with pycolmap.Database.open(matches.database) as store:
            assert store.read_camera(1).focal_length == pytest.approx(found.mapped.model.cameras[0].focal[0])


def test_photos_that_state_their_focal_lengths_are_placed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = long_photos(LONG)
    with matched(photos, seed=0, progress=silent) as matches:
        start = map_photos(matches, photos, seed=0)
        monkeypatch.setattr(few_focals, "map_photos", None)
        found = few_placed(start, matches, photos, 0)
    assert found is not None
    assert found.mapped is start


def test_photos_of_a_usual_lens_keep_theirs() -> None:
    photos = photographs(room(), arc(3))
    with matched(photos, seed=0, progress=silent) as matches:
        found = few_placed(map_photos(matches, photos, seed=0), matches, photos, 0)
    assert found is not None
    cameras = found.refined.cameras.values()
    assert [each.focal[0] / FOCAL for each in cameras] == pytest.approx([1.0] * 3, rel=0.05)
