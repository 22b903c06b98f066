"""When learned matchers are used, and on what: chosen on pairs of fox, kermit, fortress and dtu106."""

from dataclasses import dataclass

from querysplat_cli.runtime.choices import LearnedMatcherName


@dataclass(frozen=True)
class LearnedPolicy:
    """Which photos are matched by a network where SIFT has found too little, and how."""

    preferred: tuple[LearnedMatcherName, ...] = ("xfeat", "disk-lightglue")
    """What `auto` takes: the first of these whose library and weights are here."""
    feature_size: int = 960
    """Longer side, in pixels, at which a network searches a photo. Small photos are enlarged: the networks place
    features on whole pixels or little better."""
    most_features: int = 4096
    """A network keeps so many features of a photo."""
    least_score: float = 0.25
    """LightGlue's score of a match below which it is left out. With its usual 0.1, some pairs of fox that are 24 photos
    apart get a focal length that is 15 % wrong, by matches that lie near their epipolar lines and are not right."""
    enough_inliers: int = 400
    """Pairs of a few photos with fewer matches that agree are matched again. Features of a network add to those of
    SIFT."""
    most_pairs: int = 60
    """At most so many pairs are matched again: those of which SIFT finds most matches, and of neighbours."""


LEARNED_POLICY = LearnedPolicy()
