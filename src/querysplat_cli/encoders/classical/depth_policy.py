"""The thresholds of the classical encoder's multi-view stereo: what decides which depths a user gets.

They were chosen as those of `policy.py`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class DepthPolicy:
    """Multi-view stereo: which views are compared, what a match costs, and when a depth is confirmed or filled in.

    Numba compiles some of these numbers into kernels, and its cache depends on the kernel's own file only. After a
    change here, touch the files that import `DEPTH_POLICY`, or clear numba's cache.
    """

    # Contrast.
    little_contrast: tuple[float, float] = (0.04, 0.3)
    """Brightness ([0, 1]) between the darkest and the brightest hundredth, from and up to which pictures are stretched:
    costs and colours are compared by absolute brightness."""
    usual_contrast: float = 0.8
    """Brightness between them then."""

    # Which views are compared, and between which depths.
    sources: int = 4
    """A view is measured against at most so many others."""
    free_space_views: int = 16
    """Free space is tested against so many of the nearest views, which keeps the time linear in the views."""
    few_own_points: int = 8
    """A view that observes fewer points takes its depth range from the points of all views."""
    fewest_shared_points: int = 5
    """Views that share fewer points do not measure each other."""
    least_angle: float = 0.3
    """Degrees between the rays of two views to a point below which they measure nothing."""
    good_angles: tuple[float, float] = (6.0, 25.0)
    """Degrees between which an angle is best."""
    nearer_than_points: float = 1.4
    """Inverse depth is searched up to this multiple of the nearest point's."""
    nearest_point: float = 99.5
    """The nearest point is this percentile of the inverse depths: wrong points are often near."""
    points_together: int = 4
    """But nearer points count where so many have nearly one depth: wrong points lie apart."""
    nearly_one_depth: float = 1.1
    """Inverse depths that differ at most by this factor are nearly one."""
    farther_than_points: float = 0.2
    """Inverse depth is searched down to this multiple of the farthest point's."""

    # Plane sweep (sweep.py, depth.py).
    planes: tuple[int, int] = (48, 256)
    """Fewest and most planes of a sweep."""
    edge_slope: float = 0.02
    """Relative change of inverse depth between neighbouring pixels above which it is an edge, not a slope."""
    sweep_reach: int = 2
    """The correlation window reaches so many pixels to each side."""
    unseen_cost: float = 0.8
    """Cost, of 1, in a source that does not see the point. It keeps a depth from winning by leaving the pictures."""
    correlation_floor: float = 2e-5
    """Variance added to both windows ([0, 1]² grey), so that noise in even regions correlates with nothing."""

    # Semi-global matching (semiglobal.py).
    small_step: int = 6
    """Penalty for a step to the next plane, in units of the 8-bit cost."""
    large_step: int = 60
    """Penalty for a larger jump between pixels of the same brightness. It is divided by the contrast."""
    contrast: float = 0.03
    """Brightness difference ([0, 1]) at which a large jump costs half."""

    # Plane refinement (patchmatch.py).
    refinement_reach: int = 4
    """The window reaches so many pixels to each side and takes every second one: 25 samples."""
    similar_brightness: float = 0.08
    """Brightness difference ([0, 1]) at which a sample's weight in the window has fallen to 1/e."""
    prior_cost: float = 0.15
    """Cost of leaving the starting depth, so that even surfaces keep the smoothness of the sweep."""
    contradiction_cost: float = 0.4
    """Cost of a depth that the source's own depth contradicts."""
    full_cost_difference: float = 0.02
    """Relative depth difference from which the two costs above are paid in full."""

    # Confirmation, by the other views (consistency.py).
    agreement: tuple[float, float] = (0.02, 0.1)
    """Two views confirm each other within one pixel of disparity, limited to these relative depth differences."""
    forgiven_cost: float = 0.3
    """A matching cost up to this takes nothing from the confidence."""
    speck_pixels: int = 24
    """A confirmed patch of fewer pixels counts as an accident."""
    speck_step: float = 0.03
    """Largest relative change of depth between neighbouring pixels of one patch."""
    guess_confidence: float = 0.25
    """A depth of less confidence is a guess."""

    # Wider windows (wide_windows.py).
    wider: tuple[int, ...] = (4, 8)
    """Windows are so many times as wide as usual where the usual ones find nothing, the narrowest ones first."""
    wide_side: int = 16
    """Pictures whose shorter side would have fewer pixels are not measured so."""
    wide_known: float = 0.5
    """A wide window says nothing where this share of it and more is confirmed already."""
    wide_confidence: float = 0.3
    """A depth that wider windows confirm has so much of its confidence in the filling."""

    # Free space: guesses that hide what other views see move back (consistency.py).
    measured_confidence: float = 0.5
    """From this confidence on, a depth means that the space in front of it is empty."""
    in_front: float = 0.05
    """A guess may stand in front of a measured surface by this fraction of its depth. Guesses that lie this close to
    each other support each other."""
    in_front_of_guess: float = 0.1
    """The same fraction in front of another guess."""
    other_colour: float = 0.05
    """Colour difference above which a guess cannot be the surface that another view sees."""
    same_colour: float = 0.1
    """Colour difference below which it can."""
    colour_window: int = 7
    """Colours are compared as means over squares of so many pixels a side."""
    push_back: float = 0.9
    """A guess moves back by this factor of its inverse depth until it hides nothing."""

    # Filling in (fill_depth.py).
    fill_smoothness: float = 4000.0
    """How far a measured depth spreads over even colour (the filter's lambda)."""
    fill_edge: float = 6.0
    """Colour difference (of 255) across which it does not spread (the filter's sigma)."""
    guess_weight: float = 1e-4
    """Weight of a guess, where a confirmed depth weighs 1: guesses count where nothing else does."""
    fill_ridge: float = 20.0
    """Pixels. Confirmed depths that lie closer together than this do not tilt the plane that is continued."""
    fill_tilt: float = 0.5
    """A plane is continued to at most this share of its inverse depth more or less."""
    lent_confidence: float = 0.3
    """What another view measured, seen from a view that measured nothing there, weighs so much."""

    # Depth maps that came with the photos (depth_map_fit.py).
    given_sure: float = 0.75
    """Confidence from which stereo's depth stands, and a map is compared with it. A white wall has up to 1/2: its
    views agree, and match badly."""
    given_pixels: int = 200
    """A map is compared with stereo where that is sure of so many pixels."""
    given_gain: float = 0.8
    """A scale of its own, or a shift too, is taken where it leaves this share of the difference or less."""
    given_fine: float = 0.02
    """But not where the mean difference, relative to depth, is as small as this."""
    given_common: float = 0.04
    """The maps have a common unit where none differs by more with it, in the mean and relative to depth."""
    given_scale: float = 4.0
    """Such a scale differs from that of all maps by less than this factor: where stereo spreads a thing beyond its
    edges, a map of one depth would fit best."""
    given_lines: int = 300
    given_samples: int = 5000
    """Scale and shift are the best of so many lines through two pixels, as judged by so many pixels."""
    given_difference: float = 0.1
    """A map that differs by more, in the median and relative to depth, contradicts the photos, and is not used."""
    given_confidence: float = 0.5
    """Of a map's depth that no view confirms: that of a depth which one view confirms."""
    given_edge: int = 5
    """Pixels of the square in which such a map must be smooth. LiDAR of phones has 256 pixels a side."""
    given_step: float = 0.1
    """Relative difference of depth in it from which there is an edge."""

    # A warning (depth_warnings.py).
    agreeing_share: float = 0.3
    """Photos that agree on the depth of less of what they share are warned of. Of 90 pairs of the sets that are tuned
    on, the cameras of the 26 below are wrong by 8.7° in the median, and those of the others by 1.8° (docs/tried.md)."""


DEPTH_POLICY = DepthPolicy()
