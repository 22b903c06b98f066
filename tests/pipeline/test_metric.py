"""--scale: what it says, and what it does to the frame of a scene's files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline import reconstruct as pipeline
from querysplat_cli.pipeline.metric import check_scale, metres_of, rescaled_frame
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.lengths import read_scale
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.metres import Metres
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo, Views

NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")
EAST = 74_628.0
PHOTOS = [Photo(name, Path(name), np.zeros((32, 48, 3), np.uint8), gps=Gps(50.0, 8.0)) for name in NAMES[:4]]


def in_a_row() -> Cameras:
    """Cameras two units apart along a bent line."""
    w2c = torch.eye(4).repeat(5, 1, 1)
    w2c[:, 0, 3] = -2.0 * torch.arange(5)
    w2c[:, 2, 3] = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    return Cameras(w2c, torch.eye(3).repeat(5, 1, 1), 10, 10)


def posed(cameras: Cameras) -> PosedViews:
    count = len(cameras)
    masks = torch.ones(count, 10, 10, dtype=torch.bool)
    views = Views(torch.zeros(count, 3, 10, 10), masks, NAMES, ((10, 10),) * count)
    return PosedViews(views, cameras, torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),) * count)


@pytest.mark.parametrize("text", ["gps", "a.jpg,b.jpg=1.5", "a.jpg,b.jpg=1.5;c.jpg,d.jpg=2"])
def test_what_scale_can_be(text: str) -> None:
    assert read_scale(text) == text


@pytest.mark.parametrize(
    "text", ["", "metres", "a.jpg=2", "a.jpg,b.jpg=-1", "a.jpg,b.jpg=x", "a,b=1;", "a,b=nan", "a,b=inf"]
)
def test_what_it_cannot_be(text: str) -> None:
    with pytest.raises(QuerySplatError, match="neither gps, nor depth, nor a distance"):
        read_scale(text)


def test_a_distance_between_two_cameras() -> None:
    found = metres_of("a.jpg,c.jpg=1.0", posed(in_a_row()), [])
    assert found is not None
    assert found.per_unit == pytest.approx(0.25)


def test_gps_of_the_photos() -> None:
    cameras = in_a_row()
    places = cameras.centres.double().numpy() * 10
    photos = [
        Photo(name, Path(name), np.zeros((64, 64, 3), np.uint8), gps=Gps(48 + z / 111_208, 11 + x / EAST, -y))
        for name, (x, y, z) in zip(NAMES, places, strict=True)
    ]
    found = metres_of("gps", posed(cameras), photos)
    assert found is not None
    assert found.per_unit == pytest.approx(10, rel=1e-3)
    with pytest.raises(QuerySplatError, match="0 of the 5 photos"):
        metres_of("gps", posed(cameras), [])
    with pytest.raises(QuerySplatError, match="unit already"):
        check_scale("gps", photos, poses_known=True)
    assert metres_of(None, posed(cameras), photos) is None


def test_lengths_become_metres_and_axes_stay() -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    before = Sim3(2.0, turn, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    after = rescaled_frame(before, Metres(0.5, "gps", 9, 0.1))
    points = torch.randn(6, 3, dtype=torch.float64)
    torch.testing.assert_close(after.apply(points), before.apply(points) / 4)
    alone = rescaled_frame(None, Metres(0.5, "gps", 9, 0.1))
    torch.testing.assert_close(alone.apply(points), points / 2)


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
