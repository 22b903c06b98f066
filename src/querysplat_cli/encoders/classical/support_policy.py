"""The second search of a few photos, whose matches need support: chosen on pairs of fox, kermit and dtu106."""

from dataclasses import dataclass

from querysplat_cli.encoders.classical.policy import MatchEffort

SEARCH = MatchEffort(800, True, None, 1.0, 15, first_octave=-2)
"""Features of photos that are enlarged four times, to 3,200 pixels at most. In fox's squares of 270 pixels that finds
twice as many right matches as twice the size."""


@dataclass(frozen=True)
class SupportPolicy:
    """How features are found, and what a match needs so that its neighbours support it."""

    effort: MatchEffort = SEARCH
    """How affine features are searched for, and how many matches a pair needs. Round features are added to these."""
    enough_matches: int = 100
    """A few photos are searched again when the model explains fewer matches for each photo but the first. These matches
    are more, but less exact: with them, fox's photos 10 and 16 get 1.1° of error, and 0.2° with 161 usual ones."""
    reach: float = 0.15
    """How far a neighbour may be, in longer sides."""
    tolerance: float = 0.25
    """How far a neighbour may be from where a match expects it, as a share of its distance from that match."""
    same_place: float = 1.5
    """Features this close, in pixels, count as one. A neighbour may always be so far from where it is expected."""
    alike: float = 0.8
    """How much the maps of two neighbours may differ, relative to their size."""
    neighbours: int = 2
    """So many neighbours must support a match."""
    distinct_ratio: float = 0.9
    """Matches with support stand out below this ratio of the distances to the nearest and the second nearest."""
    distinct_matches: int = 5
    """So many matches with support must stand out. In photos of different things it is one at most, where 13 have
    support by chance."""
    neighbours_grown: int = 4
    """So many after matches were added around those that have support."""
    anchors: int = 3
    """A feature is added by the maps of so many of the nearest supported matches."""
    grown_alike: float = 0.5
    """How much the shapes of an added feature may differ from what the map makes of it, relative to their size."""
    grown_angle: float = 0.65
    """Largest angle in radians between the descriptors of an added match."""
    grown_ratio: float = 0.95
    """Largest ratio of this angle to that of the second best feature in the place that the maps allow."""


SUPPORT_POLICY = SupportPolicy()
