"""Which features of a photo are kept, and cameras of large photos from those."""

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from synthetic import FOCAL, WIDTH, arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical import verified_pairs
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.features import are_large, spread_features, stretched
from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.views import Photo

CELLS = CAMERA_POLICY.spread_cells


def keypoints(places: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """COLMAP's circular keypoints [n, 4]."""
    return np.column_stack([places, scales, np.zeros(len(places))]).astype(np.float32)


@pytest.fixture(scope="module")
def large() -> list[Photo]:
    return photographs(room(), arc(4, size=(960, 1280), focal=FOCAL * 1280 / WIDTH))


def test_few_features_are_all_kept() -> None:
    some = keypoints(np.random.default_rng(0).uniform(0, 100, (50, 2)), np.ones(50))
    assert spread_features(some, 50).tolist() == list(range(50))


def test_every_cell_gives_a_feature_and_the_largest_first() -> None:
    """A crowd of large features in one corner does not push out the small ones elsewhere."""
    grid = (np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), -1).reshape(-1, 2) + 0.5) * 10
    crowd = np.full((2000, 2), 5.0)
    corners = np.array([[0.0, 0.0], [CELLS * 10, CELLS * 10]])
    scales = np.concatenate([np.ones(len(grid)), np.linspace(2, 3, 2000), [0.5, 0.5]])
    rows = spread_features(keypoints(np.concatenate([grid, crowd, corners]), scales), CELLS**2 + 10)
    assert len(rows) == CELLS**2 + 10
    assert (np.diff(rows) > 0).all()
    assert set(range(1, len(grid))) <= set(rows.tolist())
    in_crowd = rows[(rows >= len(grid)) & (rows < len(grid) + 2000)] - len(grid)
    assert in_crowd.tolist() == list(range(2000 - len(in_crowd), 2000))
    assert 0 < len(in_crowd) <= 11


def test_affine_features_are_sorted_by_their_scale() -> None:
    shapes = np.zeros((3, 6), np.float32)
    shapes[:, 2] = [1, 3, 2]
    assert spread_features(shapes, 1).tolist() == [1]


def test_most_photos_decide_whether_they_are_large(large: list[Photo]) -> None:
    small = [Photo(photo.name, photo.path, photo.pixels[:100, :100], None) for photo in large]
    assert are_large(large)
    assert not are_large(small)
    assert not are_large([*large[:2], *small[:3]])


def test_large_photos_are_placed_from_few_features(large: list[Photo]) -> None:
    most = CAMERA_POLICY.ordinary_large.most_features
    assert most
    with matched(large, seed=0, progress=lambda text, fraction: None) as matches:
        assert all(most / 10 < count <= most for count in matches.features)
    once, twice = (estimate_cameras(large, CameraRequest(256, seed=0), lambda *_: None) for _ in range(2))
    assert once.cameras.K[:, 0, 0].numpy() == pytest.approx(FOCAL * 256 / WIDTH, rel=0.03)
    assert not once.left_out
    assert once.cameras.w2c.numpy().tobytes() == twice.cameras.w2c.numpy().tobytes()
    assert once.points.numpy().tobytes() == twice.points.numpy().tobytes()


def database_of(photos: list[Photo]) -> tuple[dict[int, bytes], dict[int, tuple[bytes, ...]]]:
    """The matches of all pairs of COLMAP's numbers, and their geometries."""
    with (
        matched(photos, seed=0, progress=lambda text, fraction: None) as found,
        pycolmap.Database.open(found.database) as store,
    ):
        matches = {pair: rows.tobytes() for pair, rows in zip(*store.read_all_matches(), strict=True)}
        geometries = {
            pair: (each.inlier_matches.tobytes(), each.F.tobytes(), each.E.tobytes(), each.H.tobytes())
            for pair, each in zip(*store.read_two_view_geometries(), strict=True)
        }
    return matches, geometries


def test_blocks_of_pairs_find_what_one_call_finds(large: list[Photo], monkeypatch: pytest.MonkeyPatch) -> None:
    alone = database_of(large)
    monkeypatch.setattr(verified_pairs, "PAIR_BLOCK", 1)
    assert database_of(large) == alone
    assert len(alone[0]) == len(alone[1]) == 6


def test_no_two_threads_match_at_once(large: list[Photo], monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair would lose its matches in one to six of a hundred runs, too seldom to be seen in a test."""
    under_way, most = [], []
    real = pycolmap.match_image_pairs

    def match(*arguments: Any, matching_options: pycolmap.FeatureMatchingOptions, **more: Any) -> None:
        under_way.append(matching_options.num_threads)
        most.append(sum(under_way))
        real(*arguments, matching_options=matching_options, **more)
        under_way.pop()

    monkeypatch.setattr(pycolmap, "match_image_pairs", match)
    monkeypatch.setattr(verified_pairs, "PAIR_BLOCK", 1)
    database_of(large)
    assert most == [1] * 6


def test_photos_of_little_contrast_are_stretched_and_others_are_left() -> None:
    ramp = np.tile(np.linspace(20, 60, 201).round().astype(np.uint8), (10, 1))
    found = stretched(ramp)
    low, high = np.percentile(ramp, (1, 99))
    expected = CAMERA_POLICY.usual_contrast / (high - low) * (ramp - low)
    assert np.abs(found - expected.clip(0, 255)).max() <= 0.5
    for levels in (1, 20, 100):
        other = np.tile(np.arange(levels, dtype=np.uint8), (10, 1))
        assert stretched(other) is other


def test_dark_photos_among_others_are_placed() -> None:
    """Every other photo has a fifth of the light."""
    views = arc(6)
    photos = photographs(room(), views)
    mixed = [
        replace(photo, pixels=(photo.pixels * 0.2).round().astype(np.uint8)) if row % 2 else photo
        for row, photo in enumerate(photos)
    ]
    with matched(mixed, seed=0, progress=lambda *_: None) as matches:
        assert min(matches.features[1::2]) > 0.6 * min(matches.features[::2])
    assert len(estimate_cameras(mixed, CameraRequest(224, seed=0), lambda *_: None).views) == 6
