"""The share of a film around the scene that no photo saw."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from querysplat_cli.reporting.unseen import unseen
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import look_at


def ball(count: int = 4000) -> Gaussians:
    """Opaque Gaussians on the unit sphere."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    return Gaussians(
        directions,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.03),
        torch.full((count,), 0.99),
        torch.zeros(count, 1, 3),
    )


def cameras_at(degrees: list[float], focal: float) -> Cameras:
    """Cameras four units from the origin, level, looking at it."""
    angle = np.radians(degrees)
    places = 4 * np.stack([np.sin(angle), np.zeros(len(angle)), -np.cos(angle)], 1)
    K = torch.tensor([[focal, 0, 50.0], [0, focal, 50.0], [0, 0, 1]])
    like = Cameras(torch.eye(4)[None], K[None], 100, 100)
    return look_at(places, np.zeros(3), np.array([0.0, -1.0, 0.0]), like)


def test_photos_all_around_leave_only_the_background() -> None:
    """A ball of radius 1 at a distance of 4: a disc of radius f·1/√15 pixels."""
    found = unseen(ball(), cameras_at([0, 45, 90, 135, 180, 225, 270, 315], 100.0))
    assert found
    disc = torch.pi * (100.0**2 / 15) / 100**2
    assert found.empty == pytest.approx(1 - disc, abs=0.04)
    assert found.hidden < 0.01
    assert found.entry()["share"] == pytest.approx(found.empty + found.hidden, abs=1e-4)


def test_the_side_that_no_photo_shows_is_hidden() -> None:
    """Three of four cameras around a ball leave a side that none of them shows."""
    ring = [0.0, 90.0, 180.0, 270.0]
    whole = unseen(ball(), cameras_at(ring, 100.0))
    narrow = unseen(ball(), turned_away(cameras_at(ring, 100.0)))
    assert whole
    assert narrow
    assert narrow.hidden > whole.hidden + 0.02
    assert narrow.empty == pytest.approx(whole.empty, abs=0.01)


def turned_away(cameras: Cameras) -> Cameras:
    """The third camera turns around where it stands. So the ring of centres stays, and the film."""
    w2c = cameras.w2c.clone()
    w2c[2] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ w2c[2]
    return replace(cameras, w2c=w2c)


def test_what_lies_outside_the_photos_was_not_seen() -> None:
    """The photos show the left half of a wall. The film looks at its middle."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 40), torch.linspace(-1, 1, 40), indexing="ij")
    wall = replace(ball(1600), means=torch.stack([x.ravel(), y.ravel(), torch.zeros(1600)], 1))
    places = np.array([[-0.2, 0.0, -4.0], [0.0, 0.0, -4.0], [0.2, 0.0, -4.0]])
    like, up = cameras_at([0.0], 100.0), np.array([0.0, -1.0, 0.0])
    left = look_at(places, places + np.array([-2.0, 0.0, 4.0]), up, like)  # the right border lies at x = place
    found = unseen(wall, left)
    straight = unseen(wall, look_at(places, places * np.array([1.0, 1.0, 0.0]), up, like))
    assert found
    assert straight
    assert found.empty == pytest.approx(straight.empty, abs=0.01)
    assert straight.hidden < 0.005
    assert found.hidden == pytest.approx(0.4 * (1 - found.empty), rel=0.1)


def test_padding_shows_nothing() -> None:
    """Photos of the upper half of their canvas; the film shows the whole wall."""
    y, x = torch.meshgrid(torch.linspace(-2, 2, 80), torch.linspace(-2, 2, 80), indexing="ij")
    wall = replace(ball(6400), means=torch.stack([x.ravel(), y.ravel(), torch.zeros(6400)], 1))
    places = np.array([[-0.2, 0.0, -4.0], [0.0, 0.0, -4.0], [0.2, 0.0, -4.0]])
    cameras = look_at(places, np.zeros(3), np.array([0.0, -1.0, 0.0]), cameras_at([0.0], 100.0))
    whole, upper = unseen(wall, cameras), unseen(wall, cameras, [(50, 100)] * 3)
    assert whole
    assert upper
    assert whole.hidden < 0.1
    assert upper.hidden == pytest.approx(0.5, abs=0.1)


def test_cameras_at_what_they_look_at_make_no_film() -> None:
    one = replace(ball(1), means=torch.tensor([[0.0, 0.0, -4.0]]))
    assert unseen(one, cameras_at([0.0], 100.0)) is None


def test_the_film_has_the_shape_of_the_first_photo() -> None:
    """As `render --cameras orbit`. A portrait photo among landscape ones made it a square."""
    ring = [0.0, 45, 90, 135, 180, 225, 270, 315]
    wide = replace(cameras_at(ring, 100.0), height=60)
    alone = unseen(ball(), wide, [(60, 100)] * 8)
    mixed = unseen(ball(), replace(wide, height=100), [(60, 100)] * 7 + [(100, 60)])
    assert alone
    assert mixed
    assert mixed.empty == pytest.approx(alone.empty, abs=1e-6)
