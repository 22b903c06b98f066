"""Estimated cameras against known ones, and sets of photos that do not show one ordinary scene."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from synthetic import FOCAL, WIDTH, arc, camera, photograph, photographs, room, wall

from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.classical import matches as matches_module
from querysplat_cli.encoders.classical import photo_pairs
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.reporting import omissions
from querysplat_cli.runtime.errors import ExitCode, ImpossibleScene
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.sim3 import align_cameras
from querysplat_cli.scene.views import Photo

SIZE = 256


def place(photos: Sequence[Photo]) -> PosedViews:
    return estimate_cameras(photos, CameraRequest(SIZE, seed=0), lambda text, fraction: None)


def pose_error(posed: PosedViews, photos: Sequence[Photo], cameras: Sequence[PhotoCamera]) -> tuple[float, float]:
    """Largest rotation error in degrees, and largest displacement in units of the cameras' extent."""
    names = [photo.name for photo in photos]
    truth = torch.from_numpy(np.stack([cameras[names.index(name)].w2c for name in posed.views.names]))
    similarity = align_cameras(posed.cameras.w2c.double(), truth)
    found = posed.cameras.to(torch.float64).transformed(similarity)
    turn = found.w2c[:, :3, :3] @ truth[:, :3, :3].mT - torch.eye(3)
    centres = -(truth[:, :3, :3].mT @ truth[:, :3, 3:])[..., 0]
    # |R − 1| = 2·√2·sin(angle / 2) in the Frobenius norm.
    degrees = torch.rad2deg(2 * torch.asin((turn.flatten(1).norm(dim=1) / 8**0.5).clamp_max(1)))
    shift = (found.centres - centres).norm(dim=1) / torch.pdist(centres).max()
    return float(degrees.max()), float(shift.max())


@pytest.fixture(scope="module")
def six() -> list[Photo]:
    return photographs(room(), arc(6))


@pytest.fixture(scope="module")
def posed(six: list[Photo]) -> PosedViews:
    return place(six)


def test_poses_and_focal_length(six: list[Photo], posed: PosedViews) -> None:
    degrees, shift = pose_error(posed, six, arc(6))
    assert degrees < 0.2
    assert shift < 0.003
    assert posed.cameras.K[:, 0, 0].numpy() == pytest.approx(FOCAL * SIZE / WIDTH, rel=0.03)
    assert not posed.warnings
    assert not posed.left_out


def test_the_frame(posed: PosedViews) -> None:
    assert torch.equal(posed.cameras.w2c[0], torch.eye(4))
    local = [
        posed.points[rows] @ w2c[2, :3] + w2c[2, 3]
        for rows, w2c in zip(posed.visibility, posed.cameras.w2c, strict=True)
    ]
    assert float(np.median(torch.cat(local))) == pytest.approx(1, abs=1e-4)
    assert all((depths > 0).all() for depths in local)


def test_points_lie_on_the_surfaces(six: list[Photo], posed: PosedViews) -> None:
    """A sparse point has the same colour in two views, so it projects to the same place on a surface."""
    shared = np.intersect1d(posed.visibility[2], posed.visibility[3])
    assert len(shared) > 100
    colours = []
    for view in (2, 3):
        points = posed.points[shared] @ posed.cameras.w2c[view, :3, :3].T + posed.cameras.w2c[view, :3, 3]
        pixels = points @ posed.cameras.K[view].T
        column, row = (pixels[:, :2] / pixels[:, 2:]).long().unbind(1)
        colours.append(posed.views.images[view][:, row, column])
    assert float((colours[0] - colours[1]).abs().median()) < 0.05


def test_canvas(posed: PosedViews) -> None:
    height, width = posed.views.images.shape[-2:]
    assert (height, width) == (192, 264)
    assert set(posed.views.sizes) == {(192, 256)}
    assert posed.views.masks[:, :, :256].all()
    assert not posed.views.masks[:, :, 256:].any()
    assert posed.cameras.K[0, :2, 2].tolist() == pytest.approx([128, 96], abs=1)


def test_same_photos_same_bits(six: list[Photo], posed: PosedViews) -> None:
    again = place(six)
    assert torch.equal(again.cameras.w2c, posed.cameras.w2c)
    assert torch.equal(again.cameras.K, posed.cameras.K)
    assert torch.equal(again.points, posed.points)
    assert torch.equal(again.views.images, posed.views.images)


def test_lens_distortion_is_removed() -> None:
    cameras = arc(6, distortion=(-0.15, 0.03, 0.0, 0.0))
    photos = photographs(room(), cameras)
    found = place(photos)
    degrees, shift = pose_error(found, photos, cameras)
    assert degrees < 0.2
    assert shift < 0.003


def test_colmap_is_silent(six: list[Photo], capfd: pytest.CaptureFixture[str]) -> None:
    place(six[:3])
    assert capfd.readouterr() == ("", "")


def test_two_photos_and_what_exif_adds(six: list[Photo]) -> None:
    cameras = arc(6)[2:4]
    alone = place(six[2:4])
    assert pose_error(alone, six, arc(6))[0] < 3
    assert any("focal" in warning for warning in alone.warnings)
    photos = [photograph(room(), each, f"{i}.png", FOCAL) for i, each in enumerate(cameras)]
    stated = place(photos)
    assert pose_error(stated, photos, cameras)[0] < 0.2
    assert not stated.warnings


def test_photos_of_mixed_sizes_and_lenses() -> None:
    cameras = [
        *arc(3),
        camera((-0.9, 0.1, 0.1), size=(320, 240)),
        camera((0.2, 0.3, 0), size=(320, 240)),
        camera((0.8, -0.2, 0.1), size=(180, 240), focal=257.0),
    ]
    photos = photographs(room(), cameras)
    found = place(photos)
    degrees, shift = pose_error(found, photos, cameras)
    assert degrees < 0.2
    assert shift < 0.003
    assert found.views.sizes == ((192, 256),) * 3 + ((256, 192),) * 2 + ((180, 240),)
    assert found.views.images.shape[-2:] == (264, 264)
    for mask, (height, width) in zip(found.views.masks, found.views.sizes, strict=True):
        assert mask[:height, :width].all()
        assert mask.sum() == height * width
    focals = found.cameras.K[:, 0, 0].tolist()
    assert focals == pytest.approx([FOCAL * SIZE / WIDTH] * 5 + [257], rel=0.05)


def test_another_place_is_left_out_by_name(six: list[Photo]) -> None:
    other = photographs(room(50), arc(3), "other")
    found = place([other[0], *six, *other[1:]])
    assert found.views.names == tuple(photo.name for photo in six)
    assert [left.name for left in found.left_out] == ["other0.png", "other1.png", "other2.png"]
    assert all("another place" in left.why for left in found.left_out)


def test_spoilt_photos_are_left_out_by_name(six: list[Photo]) -> None:
    spoilt = {
        "blurred": cv2.GaussianBlur(six[2].pixels, (0, 0), 12),
        "dark": six[3].pixels // 40,
        "plain": np.full_like(six[0].pixels, 128),
    }
    found = place([*six, *(Photo(name, Path(name), pixels) for name, pixels in spoilt.items())])
    assert len(found.views) == 6
    assert {left.name for left in found.left_out} == set(spoilt)
    assert all("too little detail" in left.why for left in found.left_out)


def test_copies_are_used_once(six: list[Photo]) -> None:
    copy = Photo("copy.png", Path("copy.png"), six[0].pixels.copy())
    found = place([six[0], copy])
    assert found.views.names == ("0.png",)
    assert found.left_out[0].why == "it is the same picture as 0.png"
    assert "one photo" in found.warnings[0]


@pytest.mark.parametrize("focal", [None, 400.0])
def test_one_photo(six: list[Photo], focal: float | None) -> None:
    found = place([Photo("one.png", Path("one.png"), six[0].pixels, focal)])
    assert torch.equal(found.cameras.w2c, torch.eye(4)[None])
    assert found.cameras.K[0, 0, 0].item() == pytest.approx((focal or 1.2 * WIDTH) * SIZE / WIDTH)
    assert len(found.points) == 0
    assert ("45°" if focal is None else "44°") in found.warnings[0]


@pytest.mark.parametrize(
    "focal", [pytest.param(250.0, marks=pytest.mark.slow), pytest.param(304.0, marks=pytest.mark.slow), 560.0, 700.0]
)
def test_pure_rotation_is_recognised(focal: float) -> None:
    directions = [((0, 0, 5), 0), ((1, 0.2, 5), 0.1), ((-0.8, 0.5, 5), 0), ((0.5, -0.6, 5), -0.1)]
    cameras = [camera((0, 0, 0), look_at, roll, focal=focal) for look_at, roll in directions]
    found = place(photographs(room(), cameras))
    assert len(found.views) == 4
    assert torch.equal(found.cameras.w2c[:, :3, 3], torch.zeros(4, 3))
    assert found.cameras.K[0, 0, 0].item() == pytest.approx(focal * SIZE / WIDTH, rel=0.03)
    relative = np.stack([each.w2c[:3, :3] @ cameras[0].w2c[:3, :3].T for each in cameras])
    assert found.cameras.w2c[:, :3, :3].numpy() == pytest.approx(relative, abs=0.003)
    assert len(found.points) == 0
    assert "did not move" in found.warnings[0]


def test_two_strangers_make_a_scene_of_one() -> None:
    strangers = [photographs(room(100 + 10 * i), arc(1), str(i))[0] for i in range(2)]
    found = place(strangers)
    (used,), (left_out,) = found.views.names, found.left_out
    assert {used, left_out.name} == {photo.name for photo in strangers}
    assert left_out.why == f"nothing places it beside {used}"
    assert found.warnings[0].startswith(f"no two of the 2 photos show the same thing, so only {used} is used")
    assert "no parallax" in found.warnings[1]


@pytest.mark.slow
def test_many_strangers_are_refused() -> None:
    strangers = [photographs(room(100 + 10 * i), arc(1), str(i))[0] for i in range(5)]
    with pytest.raises(ImpossibleScene, match="no two of the 5 photos") as error:
        place(strangers)
    assert error.value.code == ExitCode.IMPOSSIBLE
    assert "overlap" in error.value.hint


def test_blank_photos_are_refused() -> None:
    blank = [replace(photo, pixels=np.full_like(photo.pixels, 99)) for photo in photographs(room(), arc(2))]
    blank[1].pixels[:] = 100
    with pytest.raises(ImpossibleScene, match="no two of the 2 photos"):
        place(blank)


def test_no_photo() -> None:
    with pytest.raises(ImpossibleScene):
        place([])


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.1, 0.03, 0.005])
def test_small_baselines(step: float) -> None:
    """Baselines of 2 %, 0.6 % and 0.1 % of the depth: sound cameras, then a warning, then no motion at all."""
    cameras = [camera((step * i, 0, 0), (step * i, 0, 6)) for i in range(4)]
    photos = photographs(room(), cameras)
    found = place(photos)
    assert len(found.views) == 4
    if step == 0.005:
        assert "did not move" in found.warnings[0]
        return
    degrees, shift = pose_error(found, photos, cameras)
    assert degrees < 0.1
    assert shift < 0.01
    assert any("hardly moved" in warning for warning in found.warnings) == (step == 0.03)


@pytest.mark.slow
def test_forward_motion() -> None:
    cameras = [camera((0.02 * i, 0, 0.3 * i), (0.02 * i, 0, 6)) for i in range(5)]
    photos = photographs(room(), cameras)
    found = place(photos)
    degrees, shift = pose_error(found, photos, cameras)
    assert degrees < 0.1
    assert shift < 0.02
    assert any("along its viewing direction" in warning for warning in found.warnings)


@pytest.mark.slow
def test_a_flat_scene_raises_a_warning() -> None:
    found = place(photographs(wall(), arc(5)))
    assert len(found.views) == 5
    assert any("one plane" in warning for warning in found.warnings)


def test_nothing_is_left_behind_by_ctrl_c(six: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def interrupt(text: str, fraction: float) -> None:
        assert list(tmp_path.iterdir())
        if "matching" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_cameras(six[:2], CameraRequest(SIZE, seed=0), interrupt)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("looked_up", [3, 100])
def test_many_photos_are_matched_with_the_most_similar(
    six: list[Photo], monkeypatch: pytest.MonkeyPatch, looked_up: int
) -> None:
    few = replace(photo_pairs.CAMERA_POLICY, exhaustive_photos=3, most_partners=2, looked_up=looked_up, words=8)
    monkeypatch.setattr(photo_pairs, "CAMERA_POLICY", few)
    shuffled = [six[i] for i in (3, 0, 5, 1, 4, 2)]
    found = place(shuffled)
    degrees, _ = pose_error(found, six, arc(6))
    assert len(found.views) == 6
    assert degrees < 0.2


def test_pairs_that_match_by_chance_are_counted(six: list[Photo], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matches_module, "CAMERA_POLICY", replace(CAMERA_POLICY, exhaustive_photos=3))
    monkeypatch.setattr(matches_module, "remove_chance_pairs", lambda store, pairs, *_: pairs[:-2])
    assert place(six).chance_pairs == 2
    assert omissions.chance_pairs(2).saved.startswith("2 ")
