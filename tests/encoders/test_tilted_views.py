"""Photos of very different directions are matched through tilted views, and the maps of these views are exact."""

import cv2
import numpy as np
import pytest
from synthetic import camera, photographs, wall

from querysplat_cli.encoders.classical.epipolar import epipolar_error
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.tilted_views import tilted, with_tilted_views

SIZE = (480, 640)
STEEP = [camera(place, (0, 0, 6), size=SIZE, focal=700.0) for place in ((-0.3, 0, 1), (5.4, 0.6, 3.4))]
"""In front of the wall, and 64° to its side."""


@pytest.mark.parametrize(("tilt", "degrees"), [(1.0, 30.0), (2.0, 0.0), (2.0, 36.0), (3.0, 144.0)])
def test_the_map_leads_back_to_the_photo(tilt: float, degrees: float) -> None:
    place = np.array([61.5, 88.5])
    y, x = np.mgrid[:120, :160] + 0.5
    spot = 255 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 6.0**2))
    picture, back = tilted(spot.astype(np.uint8), tilt, degrees)
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    in_photo = np.stack([u, v], -1) @ back[:, :2].T + back[:, 2]
    # Beyond the photo lies its mirror image.
    weight = picture * ((in_photo > 0) & (in_photo < [160, 120])).all(-1).astype(float)
    assert (in_photo * weight[..., None]).sum((0, 1)) / weight.sum() == pytest.approx(place, abs=0.1)
    assert abs(np.linalg.det(back[:, :2])) == pytest.approx(tilt)


def test_a_tilted_view_holds_the_whole_photo() -> None:
    picture, back = tilted(np.zeros((120, 160), np.uint8), 2.0, 36.0)
    to_view = cv2.invertAffineTransform(back)
    corners = np.array([[0, 0], [160, 0], [0, 120], [160, 120]]) @ to_view[:, :2].T + to_view[:, 2]
    assert (corners >= -1e-6).all()
    assert (corners <= np.array(picture.shape[::-1]) + 1e-6).all()


def explained(matches: Matches) -> tuple[int, float]:
    """Matches of the first pair, and the share of them that the true cameras explain."""
    pair = matches.pairs[0]
    return len(pair), float(np.mean(epipolar_error(pair, STEEP[pair.first], STEEP[pair.second]) < 2))


def test_photos_at_a_steep_angle_are_matched() -> None:
    photos = photographs(wall(), STEEP)
    effort = CAMERA_POLICY.ordinary_large
    with matched(photos, seed=0, progress=lambda *_: None, effort=effort) as matches:
        before = sum(map(len, matches.pairs))
        more = with_tilted_views(matches, [1], seed=0)
        count, share = explained(more)
    assert before < 30
    assert count > 3 * max(before, 20)
    assert share > 0.95
    first, second = more.pairs[0].first_pixels, more.pairs[0].second_pixels
    assert len(np.unique(first.round(3), axis=0)) > 0.8 * count
    assert ((second >= 0) & (second < [SIZE[1], SIZE[0]])).all()
