"""The thresholds of the classical encoder's structure from motion: what decides which photos and points a user gets.

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
    largest ratio of the distances to the nearest and the second nearest feature. A pair of photos needs
    `fewest_inliers` matches. Octave -1, the default, doubles the picture, and octave 0 takes it as it is. SIFT keeps
    the largest `most_found` features (None: COLMAP's number), and of these `most_features`, spread over the photo, are
    matched (None: all).
    """

    feature_size: int
    affine: bool
    peak_threshold: float | None
    match_ratio: float
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
    ordinary: MatchEffort = MatchEffort(1600, False, None, 0.8, 15, most_features=4000)
    """The usual search; ratio and inliers are COLMAP's. More than 1,600 pixels cost time and find no better matches."""
    little_contrast: tuple[float, float] = (25.0, 80.0)
    """Grey levels between the darkest and the brightest hundredth of a photo, from and up to which it is stretched.
    SIFT's contrast threshold is meant for photos that use all levels. Below, only noise would become larger."""
    usual_contrast: float = 200.0
    """Grey levels between them then."""
    thorough: MatchEffort = MatchEffort(800, True, 0.003, 0.9, 25)
    """A second, slow search, for photos that the first one did not place. It finds many features in few pixels; among
    many more candidates more agree by chance, so it needs more inliers."""
    large_photo: int = 1200
    """Photos with a longer side of at least so many pixels, in the median, are large: they have features in plenty."""
    ordinary_large: MatchEffort = MatchEffort(1600, False, None, 0.8, 15, first_octave=0, most_features=3000)
    """The usual search in large photos. The features that it skips, in the doubled picture, would not be kept."""
    tilted: MatchEffort = MatchEffort(1000, False, None, 0.9, 20, first_octave=0, most_found=2000)
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
    measured_focal_photos: int = 40
    """The mapping of more photos starts with the focal length that their pairs measure, where nothing is stated."""
    many_photos: int = 100
    """More photos have features in plenty together, and adjustments of all cameras take most of their time. The next
    three count for these. The final adjustment is the usual one."""
    many_features: int = 2000
    """So many features of a photo are matched at most."""
    many_growth: float = 1.3
    """The mapper adjusts all cameras when the model has grown by this factor (COLMAP: 1.1)."""
    many_tolerance: float = 1e-5
    """Such an adjustment ends when the error falls by less than this share of itself (COLMAP: 0)."""
    exhaustive_photos: int = 40
    """Up to this many photos, every pair is matched."""
    most_partners: int = 20
    """With more photos, each is matched with this many of the most similar ones."""
    neighbour_steps: tuple[int, ...] = (1, 2)
    """Photos are also matched when they are so many photos apart in their order."""
    film_steps: tuple[int, ...] = (3, 4, 8, 16)
    """So are frames of one film when they are so many chosen frames apart."""
    looked_up: int = 100
    """The most similar ones are sought among this many photos that look most alike as a whole."""
    words: int = 64
    """Visual words by which looks are compared (Jégou et al. 2010)."""
    word_samples: int = 20_000
    """The visual words are clusters of about so many features of all photos."""
    compared_features: int = 256
    """Similarity is judged by so many of each photo's largest features (preemptive matching, Wu 2013)."""
    compared_ratio: float = 0.8
    """Two of these features correspond below this ratio of the distances to the nearest and the second nearest."""
    chance_inliers: float = 2.0
    """Of more than `exhaustive_photos`, a pair with less than so many times the fewest inliers may agree by chance. It
    is left out where no third photo supports it, unless it alone connects two groups of photos."""
    chance_support: float = 1.5
    """A third photo supports a pair with so many times as many matches with both. Of 1,000 photos of a procedural
    street, 72 of 73 pairs of different places have no such photo, and 13 of 8,330 others."""

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
    resting: float = 1.0
    """Pixels that a match moves by at most where it rests."""
    moving: float = 0.01
    """Share of the longer side of a photo that most matches move by where the camera moved."""
    resting_tolerance: float = 2.0
    """Distance in pixels from the epipolar line up to which a match that moved counts."""
    moving_cover: float = 0.5
    """Matches that moved cover at least this share of the number of cells that resting ones cover."""

    judged_photos: int = 4
    """Of fewer placed photos, none is called misplaced: which of them are right is not known."""
    misplaced_ratio: float = 2.4
    """A photo is misplaced where the mean error of its observations is more than so many times that of the median of
    the others. Right photos of small parts of the sets that are tuned on reach 2.1, and those of whole sets 1.4."""
    misplaced_error: float = 0.7
    """And more than so many pixels."""

    # Bundle adjustment.
    adjustment_loss_scale: float = 0.5
    """Reprojection error in pixels beyond which the Cauchy loss gives a feature less and less weight."""
    second_term_error: float = 0.98
    """A second distortion term stays when it lowers the mean reprojection error to this share."""
    principal_error: float = 0.98
    """Fitted principal points stay when they lower it to this share."""
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
    adjusted_photos: int = 60
    """More photos outvote what EXIF states: their cameras and lenses stay as COLMAP's adjustment left them. Ours takes
    time with the third power of the photos."""
    stated_focal_spread: float = 0.03
    """Standard deviation of the logarithm of the focal length that EXIF states. Millimetres are rounded, and lenses
    breathe when they focus."""
    stated_focal_limit: float = 3.0
    """More than four photos that differ from EXIF by so many standard deviations are adjusted again with the prior."""
    contradiction: float = 0.95
    """They keep their own focal length where the mean error with it is below this share of that with the prior."""
    usual_focal: float = 0.75
    """Median focal length of photos without EXIF, in longer sides of a 4:3 frame around the photo."""
    usual_focal_spread: float = 0.35
    """Standard deviation of its logarithm."""
    principal_spread: float = 0.01
    """Standard deviation of the principal point around the middle of the photo, in longer sides."""
    distortion_spread: tuple[float, float] = (0.1, 0.1)
    """Standard deviations of the distortion terms k1 and k2 around zero."""
    lens_apart_photos: int = 100
    """Up to so many photos, it is tested whether they share a lens. The test takes as long as the final adjustment."""
    lens_difference: float = 0.05
    """Photos share no lens where one of them, given a lens of its own, has a focal length that differs by more, and
    `lens_apart_error` holds."""
    lens_apart_error: float = 0.85
    """With a lens of its own, the mean error of its observations falls below this share (docs/tried.md)."""
    lens_apart_observations: int = 60
    """A photo with fewer observations does not tell its own lens from wrong matches."""
    zoom_difference: float = 0.12
    """Two photos share no lens where focal lengths of their own differ by more, and `lens_apart_cost` holds."""
    lens_apart_cost: float = 0.85
    """Two lenses lower the cost below this share."""
    wrong_error: float = 4.0
    """In pixels; larger errors of observations count as this."""
    lens_gaps: tuple[float, ...] = (0.12, 0.06, 0.03)
    """Focal lengths of one lens differ by less from the next one. The first gap is taken that meets
    `lens_tolerance`."""
    lens_tolerance: float = 1.05
    """With the lenses of a gap, the mean error is at most so many times that with a lens for each photo."""
    few_photos: int = 4
    """With so few photos or fewer the mapper keeps the lens of the prior, and only the adjustment fits it."""
    tried_focals: tuple[float, ...] = (-1.0, 0.0, 1.0)
    """Focal lengths from which two photos without EXIF are adjusted, in standard deviations of the prior."""
    few_focals: tuple[float, ...] = (-1.0, 1.0, 2.0, 3.0)
    """The same for three and four photos, beside the mean of the prior. Too short a focal length stays too short:
    lenses of 20° need the last one."""
    tried_zooms: tuple[tuple[float, float], ...] = ((-0.75, 0.75), (0.75, -0.75))
    """The same for two photos with a lens each."""
    fewest_two_view_points: int = 15
    """Two photos need so many points."""
    fewest_two_view_share: float = 0.25
    """These points must be such a share of all matches of the two photos."""
    most_two_view_rounds: int = 5
    """A pose of two photos is adjusted until it explains the same matches as before, at most so many times."""
    settled_share: float = 0.01
    """It explains the same matches where no larger share of them changes. Thousands hardly ever stay all the same, and
    each time takes as long as the first."""
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
    """The decision is made on at most so many pairs, those with most matches that moved far."""
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


CAMERA_POLICY = CameraPolicy()
