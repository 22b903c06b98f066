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
    enough_inliers: int = 400
    """Pairs of a few photos with fewer matches that agree are matched again. Features of a network add to those of
    SIFT."""
    most_pairs: int = 60
    """At most so many pairs are matched again: those of which SIFT finds most matches, and of neighbours."""


LEARNED_POLICY = LearnedPolicy()
