"""Photos of one size that were zoomed or cropped get a lens for each focal length."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import FOCAL, arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical import several_lenses
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.several_lenses import focal_groups
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo

SHARE = 0.7
"""Of the width and height that a crop keeps."""


def cropped(photo: Photo) -> Photo:
    """The middle of a photo, enlarged to the photo's size, as a zoom makes it."""
    height, width = photo.pixels.shape[:2]
    rows, columns = round(SHARE * height), round(SHARE * width)
    top, left = (height - rows) // 2, (width - columns) // 2
    middle = np.ascontiguousarray(photo.pixels[top : top + rows, left : left + columns])
    return replace(photo, pixels=cv2.resize(middle, (width, height), interpolation=cv2.INTER_CUBIC))


def quiet(text: str, fraction: float | None) -> None:
    pass


def test_zoomed_photos_have_a_lens_of_their_own() -> None:
    photos = photographs(room(), arc(8))
    mixed = [cropped(photo) if number % 2 else photo for number, photo in enumerate(photos)]
    posed = estimate_cameras(mixed, CameraRequest(max(photos[0].pixels.shape), seed=0), quiet)
    zoom = [camera.focal[0] / FOCAL for camera in posed.photo_cameras]
    assert zoom == pytest.approx([1, 1 / SHARE] * 4, rel=0.02)
    assert any("4 span" in warning for warning in posed.warnings)


def test_a_warning_where_no_lenses_explain_as_many_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = photographs(room(), arc(6))
    mixed = [cropped(photo) if number % 2 else photo for number, photo in enumerate(photos)]
    monkeypatch.setattr(several_lenses, "_explains_as_much", lambda *models: False)
    posed = estimate_cameras(mixed, CameraRequest(448, seed=0), quiet)
    assert any("do not seem to share a lens" in warning for warning in posed.warnings)


def test_photos_of_one_lens_keep_it() -> None:
    posed = estimate_cameras(photographs(room(), arc(8)), CameraRequest(448, seed=0), quiet)
    assert len({camera.focal for camera in posed.photo_cameras}) == 1
    assert not any("lens" in warning for warning in posed.warnings)


@pytest.mark.parametrize("count", [3, 4])
def test_a_few_zoomed_photos_have_a_lens_each_and_a_warning(count: int) -> None:
    photos = photographs(room(), arc(count))
    mixed = [*photos[:-1], cropped(photos[-1])]
    posed = estimate_cameras(mixed, CameraRequest(448, seed=0), quiet)
    focals = [camera.focal[0] for camera in posed.photo_cameras]
    assert focals[-1] / np.mean(focals[:-1]) == pytest.approx(1 / SHARE, rel=0.1)
    assert any("do not share a lens" in warning for warning in posed.warnings)


@pytest.mark.parametrize("count", [3, 4])
def test_a_few_photos_of_one_lens_keep_it(count: int) -> None:
    posed = estimate_cameras(photographs(room(), arc(count)), CameraRequest(448, seed=0), quiet)
    assert len({camera.focal for camera in posed.photo_cameras}) == 1
    assert not any("lens" in warning for warning in posed.warnings)


def test_groups_divide_a_lens_and_never_join_two() -> None:
    focals = {0: 500.0, 1: 800.0, 2: 510.0, 4: 500.0}
    assert focal_groups(focals, [1, 1, 1, 1, 2], 0.06) == [0, 1, 0, 1, 2]
    assert focal_groups(focals, [1, 1, 1, 1, 2], 0.01) == [0, 2, 1, 2, 3]


@given(
    st.lists(st.tuples(st.floats(100, 5000), st.integers(0, 2)), min_size=1, max_size=20),
    st.sampled_from([0.03, 0.06, 0.12]),
)
def test_focal_lengths_of_a_group_have_no_gap(photos: list[tuple[float, int]], gap: float) -> None:
    groups = focal_groups(dict(enumerate(focal for focal, _ in photos)), [lens for _, lens in photos], gap)
    for group in set(groups):
        members = [photo for photo, number in zip(photos, groups, strict=True) if number == group]
        assert len({lens for _, lens in members}) == 1
        logarithms = np.sort(np.log([focal for focal, _ in members]))
        assert np.diff(logarithms).max(initial=0) <= np.log1p(gap)
    assert set(groups) == set(range(max(groups) + 1))


def test_errors_are_distances_from_the_projections() -> None:
    w2c = np.eye(4)
    w2c[:3, 3] = 0.1, -0.2, 0.3
    camera = PhotoCamera(w2c, (500.0, 520.0), (320.0, 240.0), (0.1, -0.05, 0.0, 0.0), 480, 640)
    points = np.array([[0.2, 0.1, 2.0], [-0.5, 0.4, 3.0], [0.0, 0.0, 1.0]])
    x, y, z = (points + w2c[:3, 3]).T
    square = (x / z) ** 2 + (y / z) ** 2
    stretch = 1 + 0.1 * square - 0.05 * square**2
    pixels = np.stack([500 * x / z * stretch + 320, 520 * y / z * stretch + 240], 1)
    aside = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, -2.0]])
    model = SparseModel({7: camera}, points, {7: np.arange(3)}, {7: pixels + aside})
    assert model.errors(7) == pytest.approx([5, 0, 2], abs=1e-9)
