"""The focal length that EXIF states, over all the ways of stating it, and over damaged entries."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from querysplat_cli.scene.exif import FULL_FRAME_DIAGONAL, MILLIMETRES, SENSIBLE_FOCAL
from querysplat_cli.scene.photos import load_photos

WIDTH, HEIGHT = 160, 120
SENSORS = st.floats(4.0, 36.0)
"""Widths in millimetres: from phones to full frame."""


def stated_focal(tags: Mapping[int, object], size: tuple[int, int] = (WIDTH, HEIGHT)) -> float | None:
    data = Image.Exif()
    data.get_ifd(ExifTags.IFD.Exif).update(tags)
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.jpg")
        Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=data)
        photos, _ = load_photos([path])
    return photos[0].focal


@settings(max_examples=40, deadline=None)
@given(millimetres=st.integers(13, 400))
def test_the_film_equivalent_is_that_of_the_same_diagonal(millimetres: int) -> None:
    focal = stated_focal({ExifTags.Base.FocalLengthIn35mmFilm: millimetres})
    assert focal is not None
    half_diagonal = np.hypot(WIDTH, HEIGHT) / 2
    assert np.arctan(half_diagonal / focal) == pytest.approx(np.arctan(FULL_FRAME_DIAGONAL / 2 / millimetres))


@settings(max_examples=40, deadline=None)
@given(
    sensor=SENSORS,
    ratio=st.floats(0.5, 5.0),
    reduced=st.integers(1, 4),
    unit=st.sampled_from(sorted(MILLIMETRES)),
    side=st.sampled_from(["X", "Y"]),
)
def test_the_sensor_states_the_same_along_either_side_and_in_any_unit(
    sensor: float, ratio: float, reduced: int, unit: int, side: str
) -> None:
    """A lens of `ratio` sensor widths; the file holds every `reduced`-th pixel of the picture that was taken."""
    per_millimetre = WIDTH * reduced / sensor
    x = side == "X"
    focal = stated_focal(
        {
            ExifTags.Base.FocalLength: ratio * sensor,
            ExifTags.Base.FocalPlaneXResolution if x else ExifTags.Base.FocalPlaneYResolution: (
                per_millimetre * MILLIMETRES[unit]
            ),
            ExifTags.Base.FocalPlaneResolutionUnit: unit,
            ExifTags.Base.ExifImageWidth: WIDTH * reduced,
            ExifTags.Base.ExifImageHeight: HEIGHT * reduced,
        }
    )
    assert focal == pytest.approx(ratio * WIDTH, rel=1e-3)


def test_pixels_that_a_program_turned_keep_their_focal_length() -> None:
    tags = {
        ExifTags.Base.FocalLength: 30.0,
        ExifTags.Base.FocalPlaneXResolution: 10 * 25.4,
        ExifTags.Base.FocalPlaneResolutionUnit: 2,
        ExifTags.Base.ExifImageWidth: WIDTH,
        ExifTags.Base.ExifImageHeight: HEIGHT,
    }
    for size in ((WIDTH, HEIGHT), (HEIGHT, WIDTH)):
        assert stated_focal(tags, size) == pytest.approx(300)


@pytest.mark.parametrize(("ratio", "times"), [(0.0, 1.0), (1.0, 1.0), (1.5, 1.5)])
def test_digital_zoom_lengthens_what_the_sensor_states(ratio: float, times: float) -> None:
    """The 35 mm equivalents of phones have it already: 28 mm with a ratio of 1.951 is 55."""
    zoomed = {ExifTags.Base.DigitalZoomRatio: ratio}
    sensor = {ExifTags.Base.FocalLength: 30.0, ExifTags.Base.FocalPlaneXResolution: 10 * 25.4}
    assert stated_focal(sensor | zoomed) == pytest.approx(300 * times)
    film = {ExifTags.Base.FocalLengthIn35mmFilm: 55}
    assert stated_focal(film | zoomed) == stated_focal(film)


@pytest.mark.parametrize("size", [(160, 120), (120, 120), (160, 90), (120, 160)])
def test_the_film_equivalent_is_that_of_the_whole_sensor(size: tuple[int, int]) -> None:
    """A phone of 160 × 120 states 26 mm for squares and 16:9, too, which it cuts from that."""
    expected = 26 * 200 / FULL_FRAME_DIAGONAL
    assert stated_focal({ExifTags.Base.FocalLengthIn35mmFilm: 26}, size) == pytest.approx(expected)


def test_a_photo_that_was_cut_afterwards_states_no_focal_length() -> None:
    tags = {
        ExifTags.Base.FocalLengthIn35mmFilm: 26,
        ExifTags.Base.ExifImageWidth: 4 * WIDTH,
        ExifTags.Base.ExifImageHeight: 4 * HEIGHT,
    }
    assert stated_focal(tags) is not None
    assert stated_focal(tags, (HEIGHT, WIDTH)) is not None
    assert stated_focal(tags, (WIDTH, HEIGHT - 8)) is None


@settings(max_examples=60, deadline=None)
@given(
    tags=st.dictionaries(
        st.sampled_from(
            [
                ExifTags.Base.FocalLengthIn35mmFilm,
                ExifTags.Base.FocalPlaneResolutionUnit,
                ExifTags.Base.ExifImageWidth,
            ]
        ),
        st.integers(0, 60000),
    ),
    millimetres=st.floats(0, 1e4),
    density=st.floats(0, 1e6),
    zoom=st.floats(0, 1e6),
)
def test_any_entries_give_a_plausible_focal_length_or_none(
    tags: dict[int, object], millimetres: float, density: float, zoom: float
) -> None:
    tags = {
        **tags,
        ExifTags.Base.FocalLength: millimetres,
        ExifTags.Base.FocalPlaneXResolution: density,
        ExifTags.Base.DigitalZoomRatio: zoom,
    }
    focal = stated_focal(tags)
    low, high = SENSIBLE_FOCAL
    assert focal is None or low < focal / WIDTH < high
