"""The thresholds of the classical encoder: what decides which photos, points and depths a user gets.

Two dataclasses, one for each stage: `CAMERA_POLICY` for structure from motion, `DEPTH_POLICY` for multi-view stereo.

Sets: the thresholds without a source in their description were chosen on all of the six sets (fortress, dtu106,
kermit, fox, riverview, sceaux). Changes are chosen on fortress, dtu106, kermit and fox only; riverview and sceaux
are kept for reporting.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class MatchEffort:
    """How hard features are searched for and matched.

    `feature_size` is the longer side, in pixels, at which features are searched. `affine` fits an affine shape to
    each feature and pools over domain sizes. `peak_threshold` is SIFT's contrast threshold. `match_ratio` is the
    largest ratio of the distances to the nearest and the second nearest feature. `guided` matches once more along
    the epipolar lines. A pair of photos needs `fewest_inliers` matches. Octave -1, the default, doubles
    the picture, and octave 0 takes it as it is. SIFT keeps the largest `most_found` features (None: COLMAP's
    number), and of these `most_features`, spread over the photo, are matched (None: all).
    """

    feature_size: int
    affine: bool
    peak_threshold: float | None
    match_ratio: float
    guided: bool
    fewest_inliers: int
    first_octave: int = -1
    most_found: int | None = None
    most_features: int | None = None


@dataclass(frozen=True)
class Attempt:
    """What the mapper demands of its first pair and of each photo that it adds.

    Angles in degrees, between the rays of a point: `start_angle` for the first pair, `point_angle` for any point.
    Inliers are counts of matches: `start_inliers` for the first pair, `pose_inliers` for an added photo. The first
    pair moves along its viewing direction by at most the share `forward_motion`. With `fit_lens` False the focal
    length keeps its first guess.
    """

    start_angle: float
    start_inliers: int
    point_angle: float
    pose_inliers: int
    forward_motion: float
    fit_lens: bool = True


@dataclass(frozen=True)
class CameraPolicy:
    """Structure from motion: which matches count, when a model is accepted, and what raises a warning."""

    # Matches.
    ordinary: MatchEffort = MatchEffort(1600, False, None, 0.8, False, 15)
    """The usual search; ratio and inliers are COLMAP's. More than 1,600 pixels cost time and find no better matches."""
    thorough: MatchEffort = MatchEffort(800, True, 0.003, 0.9, False, 25)
    """A second, slow search, for photos that the first one did not place. It finds many features in few pixels; among
    many more candidates more agree by chance, so it needs more inliers."""
    large_photo: int = 1200
    """Photos with a longer side of at least so many pixels, in the median, are large: they have features in plenty."""
    ordinary_large: MatchEffort = MatchEffort(1600, False, None, 0.8, False, 15, 0, None, 3000)
    """The usual search in large photos. The features that it skips, in the doubled picture, would not be kept."""
    tilted: MatchEffort = MatchEffort(1000, False, None, 0.9, False, 20, 0, 2000)
    """The second search in large photos, in tilted views of those photos alone that were not placed."""
    tilts: tuple[tuple[float, float], ...] = ((2.0, 0.0), (2.0, 36.0), (2.0, 72.0), (2.0, 108.0), (2.0, 144.0))
    """Tilt and direction in degrees of these views. Morel & Yu take steps of 72° / tilt."""
    spread_cells: int = 16
    """A photo is divided into so many columns and rows, among which the features that are kept are spread."""
    thorough_photos: int = 20
    """The second search is made for at most this many photos; in large photos for as many times as many others."""
    few_features: float = 0.2
    """A photo with less than this share of the median number of features counts as blurred, dark or plain."""
    assumed_focal: float = 1.2
    """Focal length, in longer sides of the photo, where nothing is stated: 45° of view (COLMAP's choice)."""
    exhaustive_photos: int = 40
    """Up to this many photos, every pair is matched."""
    most_partners: int = 20
    """With more photos, each is matched with this many of the most similar ones."""
    film_steps: tuple[int, ...] = (1, 2, 3, 4, 8, 16)
    """Frames of one film are also matched when they are so many chosen frames apart."""
    compared_features: int = 256
    """Similarity is judged by so many of each photo's largest features (preemptive matching, Wu 2013)."""
    compared_ratio: float = 0.8
    """Two of these features correspond below this ratio of the distances to the nearest and the second nearest."""

    # Mapping.
    attempts: tuple[Attempt, ...] = (
        # A handful of photos has less to offer than the thousands for which COLMAP's defaults are made.
        Attempt(start_angle=4.0, start_inliers=50, point_angle=1.5, pose_inliers=20, forward_motion=0.95),
        Attempt(start_angle=1.0, start_inliers=20, point_angle=0.5, pose_inliers=15, forward_motion=1.0),
        Attempt(start_angle=12.0, start_inliers=80, point_angle=1.5, pose_inliers=20, forward_motion=0.95),
        # Where the camera hardly moved, nothing determines the focal length.
        Attempt(
            start_angle=0.2, start_inliers=20, point_angle=0.1, pose_inliers=15, forward_motion=1.0, fit_lens=False
        ),
    )
    """What the mapper tries, in this order, until a model is sound and complete."""
    extending: Attempt = Attempt(
        start_angle=1.0, start_inliers=20, point_angle=0.5, pose_inliers=12, forward_motion=1.0
    )
    """How photos with few matches are added to the best model, when no attempt was complete."""
    extending_few: Attempt = Attempt(
        start_angle=1.0, start_inliers=20, point_angle=0.5, pose_inliers=6, forward_motion=1.0, fit_lens=False
    )
    """The same for a few photos, which share few points. The matches of two photos must still agree with the model."""
    epipolar_tolerance: float = 4.0
    """Sampson distance in pixels up to which cameras explain a match (COLMAP's threshold for verified pairs)."""
    agreeing_share: float = 0.8
    """Share of the matches between placed photos that a sound model explains."""
    covered_share: float = 0.3
    """Share of the matched features that are points of a sound model."""

    # Bundle adjustment.
    adjustment_loss_scale: float = 0.5
    """Reprojection error in pixels beyond which the Cauchy loss gives a feature less and less weight."""
    second_term_error: float = 0.98
    """A second distortion term stays when it lowers the mean reprojection error to this share."""
    second_term_photos: int = 3
    """A lens may have a second distortion term from this many photos on."""
    largest_distortion: float = 1.0
    """A second term is refused when a distortion coefficient is as large as this."""
    prior_weight: float = 0.25
    """What a lens parameter costs that lies one standard deviation from its prior's mean, in pixels squared. An
    observation costs its squared error."""
    prior_weight_two: float = 1.0
    """The same for two photos, where a wrong match on the right line cannot be told from a right one."""
    independent_observations: int = 1000
    """More observations than this weigh as much as so many: their errors are partly shared, and do not average out."""
    adjusted_observations: int = 8000
    """Cameras and lenses follow from about so many observations at most, those of the longest tracks of each photo."""
    stated_focal_spread: float = 0.03
    """Standard deviation of the logarithm of the focal length that EXIF states. Millimetres are rounded, and lenses
    breathe when they focus."""
    stated_focal_limit: float = 3.0
    """More than four photos that differ from EXIF by so many standard deviations are adjusted again with the prior."""
    usual_focal: float = 0.75
    """Median focal length of photos without EXIF, in longer sides of a 4:3 frame around the photo."""
    usual_focal_spread: float = 0.35
    """Standard deviation of its logarithm."""
    principal_spread: float = 0.01
    """Standard deviation of the principal point around the middle of the photo, in longer sides."""
    distortion_spread: tuple[float, float] = (0.1, 0.1)
    """Standard deviations of the distortion terms k1 and k2 around zero."""
    few_photos: int = 4
    """With so few photos or fewer the mapper keeps the lens of the prior, and only the adjustment fits it."""
    tried_focals: tuple[float, ...] = (-1.0, 0.0, 1.0)
    """Focal lengths from which two photos without EXIF are adjusted, in standard deviations of the prior."""
    fewest_two_view_points: int = 15
    """Two photos need so many points."""
    fewest_two_view_share: float = 0.25
    """These points must be such a share of all matches of the two photos."""
    rival_cost: float = 1.25
    """A pose of two photos that costs up to so many times the lowest cost is a rival: a plane leaves two poses."""
    rival_angle: float = 5.0
    """A rival differs in its turn, or in the direction of its shift, by so many degrees."""
    rival_agreement: float = 1.5
    """A rival is taken where so many times as many pixels agree, in pictures of `agreement_size` pixels."""
    agreement_size: int = 160
    calibrated_tolerance: float = 0.004
    """Epipolar distance in longer sides up to which the prior's lens explains a match of so few photos."""

    # Pure rotation.
    rotation_tolerance: float = 0.002
    """Distance, in longer sides, up to which a rotation explains a match: a little more than the scatter of features,
    and less than the smallest motion from which depth can be measured."""
    rotation_share: float = 0.9
    """Share of the matches that rotations must explain when the camera did not move."""
    rotation_pairs: int = 30
    """The decision is made on at most so many pairs, those with most matches."""
    rotation_focals: tuple[float, float] = (0.4, 2.0)
    """Focal lengths, in longer sides, between which the search stays: beyond them a shift looks like a rotation."""
    informative_turn: float = 3.0
    """Degrees that a camera must turn before its turn determines the focal length."""

    # Warnings.
    few_points: int = 100
    """Fewer scene points raise a warning."""
    small_angle: float = 2.0
    """A median angle between the rays of a point, in degrees, below which the depth is uncertain."""
    flat_thickness: float = 0.01
    """Points count as one plane when they are this much thinner than the narrower side of what they cover."""
    field_of_view: tuple[float, float] = (15.0, 120.0)
    """Degrees along the longer side between which ordinary lenses lie."""
    exif_difference: float = 0.25
    """Relative difference from EXIF's focal length that zoom, crop and rounding do not explain."""
    forward_cosine: float = 0.9
    """Cosine between motion and viewing direction above which the camera counts as moving forward."""
    behind_share: float = 0.01
    """Share of the points behind the cameras that observe them above which there is a warning."""


@dataclass(frozen=True)
class DepthPolicy:
    """Multi-view stereo: which views are compared, what a match costs, and when a depth is confirmed or filled in.

    Numba compiles some of these numbers into kernels, and its cache depends on the kernel's own file only. After a
    change here, touch the files that import `DEPTH_POLICY`, or clear numba's cache.
    """

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


CAMERA_POLICY = CameraPolicy()
DEPTH_POLICY = DepthPolicy()
