"""What photos tell of their lens: both distortion terms, and where it looks."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import FOCAL, arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.mapping import map_photos
from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.encoders.classical.search import MatcherChoice


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(-0.3, 0.25, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)])
def test_both_distortion_terms(distortion: tuple[float, float, float, float]) -> None:
    photos = photographs(room(), arc(6, distortion=distortion))
    with matched(photos, seed=0, progress=lambda text, fraction: None) as matches:
        found = map_photos(matches, photos, seed=0)
        assert found is not None
        camera = found.refined(matches).cameras[0]
    assert camera.distortion == pytest.approx(distortion, abs=0.06)
    assert camera.focal[0] == pytest.approx(FOCAL, rel=0.01)


@pytest.mark.parametrize("kept", [1.0, 0.77])
def test_photos_cropped_off_their_middle_have_their_own_principal_point(kept: float) -> None:
    """All photos lose the right of their width; the lens looks where it looked before."""
    photos = photographs(room(), arc(6))
    width = photos[0].width
    columns = round(kept * width)
    some = [replace(photo, pixels=np.ascontiguousarray(photo.pixels[:, :columns])) for photo in photos]
    posed = estimate_cameras(some, CameraRequest(columns, seed=0), lambda text, fraction: None, MatcherChoice("sift"))
    camera = posed.photo_cameras[0]
    if kept == 1:
        assert camera.principal == (columns / 2, photos[0].height / 2)
    else:
        assert camera.principal[0] == pytest.approx(width / 2, abs=0.02 * width)
        assert camera.focal[0] == pytest.approx(FOCAL, rel=0.01)
