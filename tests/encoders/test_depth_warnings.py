"""A few photos that hardly agree on depth are warned of."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from test_depth import SLANTED, posed

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.depth import estimate_geometry
from querysplat_cli.encoders.classical.depth_warnings import agreeing_share, depth_warnings
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.runtime.progress import silent

BESIDE = [(0, 0, 0), (0.3, 0, 0)]


def moved(found: PosedViews, *, degrees: float = 0.0, shift: float | None = None) -> PosedViews:
    """The same photos with the last camera turned to the side and up, or `shift` to the right of the first."""
    w2c = found.cameras.w2c.clone()
    w2c[-1, :3, :3] = torch.from_numpy(Rotation.from_euler("xy", [degrees, degrees], degrees=True).as_matrix())
    if shift is not None:
        w2c[-1, 0, 3] = w2c[0, 0, 3] - shift
    return replace(found, cameras=replace(found.cameras, w2c=w2c))


@pytest.mark.parametrize(("degrees", "warned"), [(0, False), (8, True)])
def test_a_wrong_camera_of_two_photos_is_warned_of(degrees: float, warned: bool) -> None:
    found = estimate_geometry(moved(posed(SLANTED, BESIDE)[0], degrees=degrees), seed=0, progress=silent)
    assert [warning.startswith("the photos agree on the depth of only") for warning in found.warnings] == [
        True
    ] * warned


def test_the_share_is_that_of_the_pixels_that_another_photo_shows() -> None:
    """Cameras side by side before a wall, shifted by half a picture: each half that both show is measured in one."""
    found, depth = posed(SLANTED, BESIDE)
    wall = torch.full(depth.shape, 3.0)
    width = 3 * found.cameras.width / float(found.cameras.K[0, 0, 0])
    beside = moved(found, shift=width / 2)
    confidence = torch.zeros_like(wall)
    confidence[0] = 1
    assert agreeing_share(beside, wall, confidence) == pytest.approx(0.5)
    assert not depth_warnings(beside, wall, confidence)
    confidence[0, : wall.shape[1] // 2] = 0
    assert agreeing_share(beside, wall, confidence) == pytest.approx(0.25)
    confidence[0, : wall.shape[1] * 3 // 4] = 0
    assert depth_warnings(beside, wall, confidence)[0].startswith("the photos agree on the depth of only 12%")
    assert agreeing_share(moved(found, shift=2 * width), wall, confidence) == 1


def test_beside_a_smaller_photo_there_is_nothing_to_agree_on() -> None:
    """A photo and its own left half: what only the whole one shows was taken for shared."""
    found, depth = posed(SLANTED, BESIDE)
    wall = torch.full(depth.shape, 3.0)
    half = found.cameras.width // 2
    masks = found.views.masks.clone()
    masks[1, :, half:] = False
    sizes = (found.views.sizes[0], (found.cameras.height, half))
    narrow = moved(replace(found, views=replace(found.views, masks=masks, sizes=sizes)), shift=0.0)
    confidence = torch.zeros_like(wall)
    confidence[:, :, :half] = 1
    assert agreeing_share(narrow, wall, confidence) == 1


def test_many_photos_are_not() -> None:
    places = [(0.1 * i, 0, 0) for i in range(CAMERA_POLICY.few_photos + 1)]
    many, depth = posed(SLANTED, places)
    nothing = torch.zeros(depth.shape)
    assert not depth_warnings(many, torch.from_numpy(depth).float(), nothing)
