"""Features of masked photos lie inside the masks, and photos without features are no obstacle."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from querysplat_cli.encoders.classical import matches as matches_module
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
