"""Held-out photos: their choice, and the frame of their cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.holdout import LOOSE_PX, estimate_holdout_cameras, split_photos
from querysplat_cli.runtime.choices import HoldoutProtocol
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo, Views

SIZE = 24


def photos(count: int) -> list[Photo]:
    return [Photo(f"{i}.png", Path(f"{i}.png"), np.full((SIZE, SIZE, 3), i, np.uint8)) for i in range(count)]


def truth(count: int) -> Cameras:
    """Cameras on an arc, all towards about (0, 0, 4)."""
    w2c = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for i in range(count):
        turn = torch.from_numpy(Rotation.from_euler("yx", [0.15 * i, 0.04 * i * i]).as_matrix())
        w2c[i, :3, :3] = turn
        w2c[i, :3, 3] = -turn @ torch.tensor([0.7 * i, 0.1 * i * i, 0.05 * i], dtype=torch.float64)
    K = torch.tensor([[20.0, 0, SIZE / 2], [0, 20, SIZE / 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Cameras(w2c.float(), K, SIZE, SIZE)


def place(chosen: Sequence[Photo], count: int, frame: Sim3, turned: float = 0.0) -> PosedViews:
    """The cameras of a perfect pass in a frame of its own, rolled by `turned` degrees to the left and right in turn."""
    rows = [int(photo.name.split(".")[0]) for photo in chosen]
    cameras = truth(count)[rows].transformed(frame)
    off = torch.eye(4).repeat(len(rows), 1, 1)
    rolls = [[turned if i % 2 else -turned] for i in range(len(rows))]
    off[:, :3, :3] = torch.from_numpy(Rotation.from_euler("z", rolls, degrees=True).as_matrix())
    cameras = Cameras(off @ cameras.w2c, cameras.K, SIZE, SIZE)
    images = torch.stack([torch.from_numpy(photo.pixels).permute(2, 0, 1) / 255 for photo in chosen])
    views = Views(
        images,
        torch.ones(len(rows), SIZE, SIZE, dtype=torch.bool),
        tuple(photo.name for photo in chosen),
        ((SIZE, SIZE),) * len(rows),
    )
    points = frame.apply(torch.tensor([[1.0, 0, 8], [2, 1, 9], [1, -1, 7]]))
    return PosedViews(views, cameras, points, tuple(torch.arange(3) for _ in rows))


SHIFTED = Sim3(
    2.5,
    torch.from_numpy(Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()),
    torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64),
)


def test_the_first_and_every_nth_photo_is_held_out() -> None:
    inputs, heldout = split_photos(photos(9), 4)
    assert [photo.name for photo in heldout] == ["0.png", "4.png", "8.png"]
    assert [photo.name for photo in inputs] == ["1.png", "2.png", "3.png", "5.png", "6.png", "7.png"]
    inputs, heldout = split_photos(photos(3), None)
    assert (len(inputs), heldout) == (3, [])


def test_too_few_are_left() -> None:
    with pytest.raises(QuerySplatError, match="leaves 1"):
        split_photos(photos(2), 2)


@pytest.mark.parametrize("source", ["isolated", "joint"])
def test_both_protocols_put_held_out_cameras_right(source: HoldoutProtocol) -> None:
    """The two passes have different frames; held-out cameras are in the frame of the inputs."""
    everything = photos(9)
    asked = []

    def estimate_cameras(chosen: Sequence[Photo]) -> PosedViews:
        asked.append(len(chosen))
        return place(chosen, 9, SHIFTED if len(chosen) == 9 else Sim3.identity())

    passes = estimate_holdout_cameras(everything, 4, source, estimate_cameras, poses_known=False)
    split, frame = passes.split, Sim3.identity() if source == "isolated" else SHIFTED
    assert split.protocol == source
    assert split.heldout is not None
    assert split.inputs.views.names == ("1.png", "2.png", "3.png", "5.png", "6.png", "7.png")
    assert split.heldout[0].names == ("0.png", "4.png", "8.png")
    expected = truth(9)[[0, 4, 8]].transformed(frame).w2c
    torch.testing.assert_close(split.heldout[1].w2c, expected, atol=1e-4, rtol=1e-4)
    assert passes.warnings == ()
    if source == "joint":
        assert (asked, passes.difference) == ([9], None)
    else:
        assert asked == [9, 6]
        assert passes.difference is not None
        assert passes.difference.degrees < 1e-2
        assert passes.difference.pixels < 1e-2


def test_no_held_out_pixel_is_an_input() -> None:
    passes = estimate_holdout_cameras(
        photos(6), 3, "joint", lambda chosen: place(chosen, 6, Sim3.identity()), poses_known=True
    )
    seen = {int(value * 255 + 0.5) for value in passes.split.inputs.views.images.unique()}
    assert seen == {1, 2, 4, 5}


@pytest.mark.parametrize("known", [False, True])
def test_a_pass_that_places_held_out_photos_only(known: bool) -> None:
    """The joint protocol has nothing to make a scene of; the isolated one has no held-out camera."""

    def estimate_cameras(chosen: Sequence[Photo]) -> PosedViews:
        return place(chosen[:1], 9, Sim3.identity())

    with pytest.raises(ImpossibleScene, match="only held-out photos have a camera"):
        estimate_holdout_cameras(photos(9), 4, "joint", estimate_cameras, poses_known=known)
    if not known:
        passes = estimate_holdout_cameras(photos(9), 4, "isolated", estimate_cameras, poses_known=False)
        assert passes.split.inputs.views.names == ("1.png",)
        assert passes.split.heldout is None
        assert "cannot be scored" in passes.warnings[0]


def test_the_difference_of_the_passes_is_measured() -> None:
    """Cameras rolled by 2° in one pass, which no similarity can undo."""

    def estimate_cameras(chosen: Sequence[Photo]) -> PosedViews:
        return place(chosen, 9, Sim3.identity(), turned=2.0 if len(chosen) == 9 else 0.0)

    passes = estimate_holdout_cameras(photos(9), 4, "isolated", estimate_cameras, poses_known=False)
    assert passes.difference is not None
    assert passes.difference.degrees == pytest.approx(2.0, abs=0.15)
    assert LOOSE_PX < passes.difference.pixels < 2
    (warning,) = passes.warnings
    assert f"{passes.difference.pixels:.1f} pixels apart" in warning
    assert "--holdout-cameras joint" in warning
