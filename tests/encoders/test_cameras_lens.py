"""A lens with two distortion terms is estimated, and an ideal lens keeps no distortion."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import arc, photographs, room

from querysplat_cli.encoders.classical.mapping import map_photos
from querysplat_cli.encoders.classical.matches import matched


@pytest.mark.slow
@pytest.mark.parametrize(("distortion", "terms"), [((-0.3, 0.25, 0.0, 0.0), 2), ((0.0, 0.0, 0.0, 0.0), 1)])
def test_second_distortion_term(distortion: tuple[float, float, float, float], terms: int) -> None:
    photos = photographs(room(), arc(6, distortion=distortion))
    with matched(photos, seed=0, progress=lambda text, fraction: None) as matches:
        assert isinstance(matches.folder, Path)
        model = map_photos(matches, seed=0)
    assert model is not None
    found = model.cameras[0].distortion
    assert found[:2] == pytest.approx(distortion[:2], abs=0.06)
    assert np.count_nonzero(found) == terms
