"""Pairs of photos of different places that look alike, among the pairs of many photos."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import pycolmap

from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.verified_pairs import Pair, connected_groups


def remove_chance_pairs(
    store: pycolmap.Database, pairs: Sequence[Pair], photos: int, fewest_inliers: int
) -> tuple[Pair, ...]:
    """The pairs without those whose few matches probably agree by chance; these lose their geometry in the database.

    Where two photos with few matches show one place, the photos between them have more matches with both. Of two places
    that look alike, a third photo shows one, and has no more matches with the other. A pair is removed where it has
    less than `chance_inliers` times `fewest_inliers` matches, and no third photo has `chance_support` times as many
    with both. A pair stays that alone connects two groups of photos.
    """
    matches = {pair.ends: len(pair) for pair in pairs}
    most = CAMERA_POLICY.chance_inliers * fewest_inliers
    support = _support(matches)
    doubtful = {
        ends: count
        for ends, count in matches.items()
        if count < most and support[ends] < CAMERA_POLICY.chance_support * count
    }
    group = connected_groups([ends for ends in matches if ends not in doubtful], photos)
    removed = {(first, second) for first, second in doubtful if group[first] == group[second]}
    for first, second in sorted(removed):
        store.delete_two_view_geometry(first + 1, second + 1)
    return tuple(pair for pair in pairs if pair.ends not in removed)


def _support(matches: Mapping[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    """For each pair, the most matches that a third photo has with both; 0 where none has any."""
    of_photo: dict[int, dict[int, int]] = defaultdict(dict)
    for (first, second), count in matches.items():
        of_photo[first][second] = of_photo[second][first] = count
    found = {}
    for first, second in matches:
        one, other = of_photo[first], of_photo[second]
        found[first, second] = max((min(one[third], other[third]) for third in one.keys() & other.keys()), default=0)
    return found
