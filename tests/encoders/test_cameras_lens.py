"""Both distortion terms of a lens are estimated, and an ideal lens keeps next to none."""

import pytest
from synthetic import FOCAL, arc, photographs, room

from querysplat_cli.encoders.classical.mapping import map_photos
from querysplat_cli.encoders.classical.matches import matched


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
