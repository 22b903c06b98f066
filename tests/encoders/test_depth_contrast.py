"""Photos of little contrast, dark or taken in fog, are measured as others are. Scenes are those of test_depth.py."""

from dataclasses import replace

import pytest
from test_depth import SIDEWAYS, TWO_LAYERS, posed, seen_depth


@pytest.mark.parametrize(
    ("gain", "haze", "few"),
    [(0.12, 0.0, False), (0.15, 0.7, False), (0.12, 0.0, True)],
    ids=["dark", "fog", "one dark"],
)
def test_little_contrast_costs_no_depth(gain: float, haze: float, few: bool) -> None:
    """Matches of even regions count for nothing, by absolute brightness: half of the confirmed pixels were lost."""
    scene, _ = posed(TWO_LAYERS, SIDEWAYS)
    weak = (255 * (gain * scene.views.images + haze)).round() / 255
    if few:
        weak[1:] = scene.views.images[1:]
    normal, found = (
        seen_depth(replace(scene, views=replace(scene.views, images=each))) for each in (scene.views.images, weak)
    )
    sure = normal.confidence > 0.5
    assert float((found.confidence > 0.5).float().mean()) > 0.95 * float(sure.float().mean())
    change = (found.depth / normal.depth - 1).abs()
    assert float((change[sure] > 0.05).float().mean()) < 0.02
    assert float((change[~sure] > 0.1).float().mean()) < 0.2
