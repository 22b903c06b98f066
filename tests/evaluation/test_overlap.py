"""Targets that share nothing with the inputs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_scenes import write_room

from querysplat_cli.evaluation.overlap import unmatched_targets
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.photos import WHOLE, load_photo
from querysplat_cli.scene.views import Photo


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[Photo]:
    home = tmp_path_factory.mktemp("data") / "room"
    write_room(home, 4, size=320)
    loaded = [load_photo(frame.file, frame.name, WHOLE) for frame in find_scenes([home])[0].frames]
    return [photo for photo in loaded if isinstance(photo, Photo)]


def test_a_picture_of_something_else_is_apart(photos: list[Photo]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, photos[0].pixels.shape, dtype=np.uint8)
    other = replace(photos[0], name="other.png", path=Path("other.png"), pixels=noise)
    assert unmatched_targets(photos[:2], [photos[2], other]) == {"other.png"}
    assert unmatched_targets(photos[:2], []) == frozenset()
    assert unmatched_targets([other], photos[:2]) == {photo.name for photo in photos[:2]}
