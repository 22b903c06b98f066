"""Features of masked photos lie inside the masks."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.features import takes_part
from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.scene.views import Photo


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
