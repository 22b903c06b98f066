"""What the search for cameras reports while it goes on."""

from pathlib import Path

import numpy as np

from querysplat_cli.encoders.classical.search import MatcherChoice, search
from querysplat_cli.scene.views import Photo


def test_progress_grows_while_photos_are_matched_again() -> None:
    """The second search takes longer than the first one, and stood at 70 %."""
    noise = np.random.default_rng(0)
    photos = [
        Photo(f"{number}.png", Path(), noise.integers(0, 256, (96, 128, 3), dtype=np.uint8)) for number in range(6)
    ]
    told: list[tuple[str, float]] = []
    search(photos, MatcherChoice("sift-affine"), seed=0, progress=lambda text, share: told.append((text, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert len({share for text, share in told if text == "matching again"}) > 1
    assert shares[-1] < 1
