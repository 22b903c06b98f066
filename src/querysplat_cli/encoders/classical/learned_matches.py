"""More matches for some pairs of photos, from a network, beside those of SIFT."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.append_matches import append_features, append_matches
from querysplat_cli.encoders.classical.features import takes_part
from querysplat_cli.encoders.classical.learned_matchers import LearnedMatcher
from querysplat_cli.encoders.classical.learned_policy import LEARNED_POLICY
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.lenses import same_panorama
from querysplat_cli.scene.views import Photo


def with_learned_matches(
    matches: Matches, photos: Sequence[Photo], pairs: Sequence[tuple[int, int]], matcher: LearnedMatcher, *, seed: int
) -> Matches:
    """The matches, and more between the photos of each of these `pairs`, in the same folder and database.

    Features of the network are appended to those of their photos, and these pairs are verified again.
    """
    pairs = [pair for pair in pairs if not same_panorama(photos[pair[0]], photos[pair[1]])]
    found = {photo: matcher.features(photos[photo]) for photo in sorted({photo for pair in pairs for photo in pair})}
    with pycolmap.Database.open(matches.database) as store:
        first_new = {photo: store.num_keypoints_for_image(photo + 1) for photo in found}
        places = {photo: some.scaled(matches.sizes[photo]) for photo, some in found.items()}
        shown = {photo: takes_part(matches.folder, photo, pixels) for photo, pixels in places.items()}
        rows = {}
        for one, two in pairs:
            new = matcher.matches(found[one], found[two])
            new = new[shown[one][new[:, 0]] & shown[two][new[:, 1]]]
            rows[one, two] = new + np.array([first_new[one], first_new[two]])
        append_features(store, places)
        changed = append_matches(store, rows)
    return matches.verified_again(changed, CAMERA_POLICY.ordinary, seed)


def weak_pairs(matches: Matches, weak: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of each of the `weak` photos with every other photo that SIFT has few inliers for, in order.

    Where these are too many, those are taken that SIFT finds most matches of, right or wrong, and then photos that are
    close in the order of the photos.
    """
    if not weak:
        return []
    policy, doubtful, raw = LEARNED_POLICY, set(weak), _match_counts(matches)
    inliers = {pair.ends: len(pair) for pair in matches.pairs}
    wanted = [
        pair for pair in all_pairs(matches) if doubtful & set(pair) and inliers.get(pair, 0) < policy.enough_inliers
    ]
    best = sorted(wanted, key=lambda pair: (-raw[pair], pair[1] - pair[0], pair))
    return sorted(best[: policy.most_pairs])


def all_pairs(matches: Matches) -> list[tuple[int, int]]:
    """Every pair of photos; of many photos, those of which SIFT finds matches, right or wrong."""
    count = len(matches.sizes)
    if count <= CAMERA_POLICY.exhaustive_photos:
        return [(one, two) for one in range(count) for two in range(one + 1, count)]
    return sorted(+_match_counts(matches))


def _match_counts(matches: Matches) -> Counter[tuple[int, int]]:
    """How many matches, right or wrong, the database has of each pair of photo numbers, the smaller one first."""
    with pycolmap.Database.open(matches.database) as store:
        ids, counts = store.read_num_matches()
    numbers = [sorted(pycolmap.pair_id_to_image_pair(pair)) for pair in ids]
    return Counter({(one - 1, two - 1): count for (one, two), count in zip(numbers, counts, strict=True)})
