"""Targets that share nothing with the inputs: no method can show what is in them but by guessing."""

from collections.abc import Sequence

from querysplat_cli.encoders.classical.matches import matched
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.views import Photo


def unmatched_targets(inputs: Sequence[Photo], targets: Sequence[Photo]) -> frozenset[str]:
    """Names of the targets that have no verified matches with any input.

    Matches are those of the classical encoder: SIFT features that a common two-view geometry explains, as many as it
    needs to place a photo. The answer depends on the photos alone, so that it is the same for every method.
    """
    if not targets:
        return frozenset()
    photos = [*inputs, *targets]
    with matched(photos, seed=0, progress=silent) as matches:
        return frozenset(
            photo.name
            for number, photo in enumerate(photos)
            if number >= len(inputs) and min(matches.partners(number), default=len(photos)) >= len(inputs)
        )
