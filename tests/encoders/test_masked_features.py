"""Features of masked photos lie inside the masks, and photos without features are no obstacle."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical import matches as matches_module
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.features import takes_part
from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.views import Photo


def test_a_photo_without_features_is_similar_to_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matches_module, "CAMERA_POLICY", replace(CAMERA_POLICY, exhaustive_photos=2))
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    pixels = np.asarray(cv2.resize(noise, (240, 160), interpolation=cv2.INTER_CUBIC))
    pictures = (np.zeros_like(pixels), pixels, np.ascontiguousarray(pixels[:, 8:]))
    photos = [Photo(f"{i}.png", Path(f"{i}.png"), picture) for i, picture in enumerate(pictures)]
    with matched(photos, seed=0, progress=lambda *_: None) as matches:
        assert matches.features[0] == 0
        assert [(pair.first, pair.second) for pair in matches.pairs] == [(1, 2)]


def test_no_feature_lies_outside_the_mask() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    pixels = np.asarray(cv2.resize(noise, (240, 160), interpolation=cv2.INTER_CUBIC))
    mask = np.zeros((160, 240), bool)
    mask[:, :120] = True
    photos = [Photo("a.png", Path("a.png"), pixels, mask=mask), Photo("b.png", Path("b.png"), pixels[:, ::-1].copy())]
    with matched(photos, seed=0, progress=lambda *_: None) as matches:
        with pycolmap.Database.open(matches.database) as store:
            masked, whole = (store.read_keypoints(image)[:, :2] for image in (1, 2))
        assert len(masked) > 20
        assert masked[:, 0].max() <= 120.5 * matches.sizes[0][1] / 240
        assert whole[:, 0].max() > 150
        points = np.array([[10.0, 10.0], [200.0, 10.0]])
        assert takes_part(matches.folder, 0, points).tolist() == [True, False]
        assert takes_part(matches.folder, 1, points).all()


def test_of_copies_the_most_masked_is_used() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (160, 240, 3), dtype=np.uint8)
    left, corner = np.zeros((2, 160, 240), bool)
    left[:, :120] = True
    corner[:100, :100] = True
    photos = [
        Photo(name, Path(name), pixels.copy(), mask=mask)
        for name, mask in (("whole.png", None), ("corner.png", corner), ("left.png", left), ("again.png", corner))
    ]
    found = estimate_cameras(photos, CameraRequest(240, seed=0), lambda *_: None)
    assert found.views.names == ("corner.png",)
    assert float(found.views.masks.sum()) == pytest.approx(corner.sum(), rel=0.05)
    assert [(each.name, each.why) for each in found.left_out] == [
        ("whole.png", "it is the same picture as corner.png, of which more is masked"),
        ("left.png", "it is the same picture as corner.png, of which more is masked"),
        ("again.png", "it is the same picture as corner.png"),
    ]


def test_pictures_whose_masks_show_different_things_are_no_copies() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    pixels = np.asarray(cv2.resize(noise, (240, 160), interpolation=cv2.INTER_CUBIC))
    left, right = np.zeros((2, 160, 240), bool)
    left[:, :140] = True
    right[:, 60:] = True
    photos = [
        Photo(f"{name}.png", Path(f"{name}.png"), pixels, mask=mask) for name, mask in (("a", left), ("b", right))
    ]
    found = estimate_cameras(photos, CameraRequest(240, seed=0), lambda *_: None)
    assert not [each for each in found.left_out if "same picture" in each.why]
