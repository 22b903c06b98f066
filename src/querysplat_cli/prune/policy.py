"""Defaults of pruning: what is left out of a scene."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PrunePolicy:
    """Shares and thresholds of pruning.

    The values up to version 0.1 were chosen on the six sets of docs/benchmarks.md. New ones are chosen on fortress,
    dtu106, kermit and fox alone.
    """

    share_kept: float = 0.5
    """Share of the Gaussians that an automatic choice keeps. Optimisation makes up for most of the rest; what held-out
    views lose is in docs/parts.md."""
    psnr_per_step: float = 0.1
    """dB on the input views that one step of optimisation makes up for."""
    pixels_per_gaussian: int = 100
    """Where the photos have more pixels than this for each Gaussian, an automatic choice keeps all Gaussians."""
    hidden_change: float = 0.01
    """Least change of colour, of 1, that removing a Gaussian is counted as. Without it, Gaussians that coincide would
    all be removed, because removing any one of them changes nothing."""
    one_photo: float = 0.95
    """A Gaussian with more than this share of its blending weight in one photo is a guess. Its depth is confirmed by no
    other. With 0.99, fog stays on kermit."""
    in_front: float = 0.5
    """A guess counts as in front of what photos agree on where it keeps more than this share of the blending weight
    that it has without that."""
    hidden_share: float = 0.3
    """A guess is left out where more than this share of what it covers, seen from beside the photos, is something that
    photos agree on. With 0.6 and 0.85, kermit and fox have 0.1 to 0.2 dB less."""
    hidden_depth: float = 0.1
    """It hides only what is farther away by more than this share of its depth."""
    hiding_neighbours: int = 4
    """Each photo is paired with so many nearest others for that."""
    hiding_places: tuple[float, ...] = (-0.5, 0.5, 1.5)
    """Where cameras look from, on the line through both photos of a pair: 0 is the one and 1 the other. Without those
    beyond the photos, kermit has 1.3 dB less."""
    hiding_views: int = 60
    """Of many such cameras, so many are used, so that it takes seconds."""
    harm: float = 3.0
    """In feature space, where nothing is split to fill a gap, a guess goes only where the picture of a camera beside
    has so many times its weight in any photo. Drafts of fortress, kermit and fox then gain 0.1 to 0.2 dB, and
    one of kermit at 416 pixels 1.4; with 0, dtu106 loses 0.9."""
    psnr_of_bands: float = 0.02
    """dB on the input views that leaving out SH bands may cost."""
    tested_views: int = 8
    """The cost of leaving something out is measured on at most so many input views, evenly spaced."""
    size_shares: tuple[float, ...] = (0.5, 0.6, 0.7, 0.85)
    """Working sizes to try, as shares of the usual one, smallest first."""
    same_psnr: float = 45.0
    """dB between a picture and its copy, reduced and enlarged again, from which the two count as the same: 1.4 of 255
    levels (RMS)."""
    smallest_size: int = 160
    """Longer side of working pictures, in pixels, below which stereo finds too little."""
    duplicate_shift: float = 0.004
    """Share of the picture's width by which scene points must move from one view to another, in the median, for the
    two to count as different."""
    duplicate_overlap: float = 0.5
    """Share of a view's points that another view must see for the two to count as the same."""
    near_share: float = 0.99
    """Share of the Gaussians, the nearest ones, that stay where they are. This and the next two were chosen on
    fortress, dtu106, kermit and fox."""
    farthest: float = 1.3
    """The others are drawn in to at most this many times the distance of those."""
    reach: float = 1.6
    """So many times this distance is as far as two standard deviations of any Gaussian reach. It is more than
    `farthest`, so that none vanishes."""
    clean_influence: float = 0.01
    """`importance` of a Gaussian below which cleaning removes it. These fields were chosen on fortress, kermit and
    fox."""
    clean_extent: float = 0.9
    """Share of the Gaussians, the nearest to the middle, whose distance from it is the size of the scene."""
    clean_giant: float = 0.3
    """A Gaussian is a giant where its longest standard deviation is more than this share of the scene's size, or of its
    own distance from the middle if that is larger. It stays where it counts more in the photos than half of the
    Gaussians do: walls and skies are coloured by such."""
    clean_reach: float = 3.0
    """Standard deviations within which Gaussians touch each other."""
    clean_neighbours: int = 12
    """How many nearest Gaussians are looked at for touching ones."""
    clean_fewest: int = 10
    """A group of fewer touching Gaussians is an island in any scene."""
    clean_island: float = 0.001
    """Share of the Gaussians that a group of touching ones must have to be no island."""
    lod_finest: int = 1_000_000
    """Levels of detail are halved until the coarsest has no more Gaussians than this. There is one coarser level at
    least."""
    lod_leaf: int = 1 << 15
    """A leaf of the tree of streamed files has at most so many Gaussians of the finest level. A viewer chooses a level
    for each leaf."""
    lod_chunk: int = 1 << 19
    """A chunk of streamed files, which a viewer loads at once, has at most so many Gaussians, or is one leaf."""
    lod_neighbours: int = 8
    """A Gaussian is merged with one of so many nearest others."""
    lod_colour: float = 0.05
    """Difference of two colours, each channel from 0 to 1, that counts as much as a distance of two standard
    deviations between equal Gaussians."""


PRUNE_POLICY = PrunePolicy()
