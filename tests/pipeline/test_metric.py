"""--scale: what it says, and what it does to the frame of a scene's files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.metric import metres_of, rescaled_frame
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.lengths import read_scale
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.metres import Metres
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo, Views

NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")
EAST = 74_628.0


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
    with pytest.raises(QuerySplatError, match="neither gps nor a distance"):
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
        metres_of("gps", posed(cameras), photos, poses_known=True)
    assert metres_of(None, posed(cameras), photos) is None


def test_lengths_become_metres_and_axes_stay() -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    before = Sim3(2.0, turn, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    after = rescaled_frame(before, Metres(0.5, "gps", 9, 0.1))
    points = torch.randn(6, 3, dtype=torch.float64)
    torch.testing.assert_close(after.apply(points), before.apply(points) / 4)
    alone = rescaled_frame(None, Metres(0.5, "gps", 9, 0.1))
    torch.testing.assert_close(alone.apply(points), points / 2)
