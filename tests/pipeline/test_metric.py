"""A value of --scale that cannot hold is refused as soon as the photos are read, before the slow search for cameras."""

from pathlib import Path

import numpy as np
import pytest

from querysplat_cli.pipeline import reconstruct as pipeline
from querysplat_cli.pipeline.metric import check_scale
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.views import Photo

PIXELS = np.zeros((32, 48, 3), np.uint8)
PHOTOS = [Photo(name, Path(name), PIXELS, gps=Gps(50.0, 8.0)) for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg")]


@pytest.mark.parametrize("scale", [None, "gps", "a.jpg,b.jpg=1.5"])
def test_what_may_hold_is_left_to_the_cameras(scale: str | None) -> None:
    check_scale(scale, PHOTOS, poses_known=False)


@pytest.mark.parametrize(
    ("scale", "known", "why"),
    [
        ("gps", True, "have a unit already"),
        ("a.jpg,z.jpg=1.5", False, "z.jpg is none of the photos"),
        ("gps", False, "3 of the 3 photos"),
    ],
)
def test_what_cannot_is_refused(scale: str, known: bool, why: str) -> None:
    with pytest.raises(QuerySplatError, match=why):
        check_scale(scale, PHOTOS[: 3 if scale == "gps" else 4], poses_known=known)


def test_no_camera_is_looked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("cameras were looked for")

    monkeypatch.setattr(pipeline, "_find_cameras", fail)
    demo = Path(pipeline.__file__).parents[1] / "demo_photos"
    settings = ReconstructSettings((demo,), tmp_path / "a.ply", metres_by="none.jpg,neither.jpg=2")
    with pytest.raises(QuerySplatError, match="none of the photos used"):
        reconstruct(settings)
