"""The settings of this stage that decide what a user gets, in one place."""

from dataclasses import dataclass


@dataclass(frozen=True)
class QueryPolicy:
    """Where queries are placed, and what their prior Gaussians look like.

    Where sets are named, a value was chosen by looking at these sets. The others were set by their meaning, and no
    comparison of alternatives is recorded. The bundled checkpoint was trained with the fields from `fill` on, so a
    change of these needs training.
    """

    finest_cell: int = 2
    """Pixels along the side of the smallest cells."""
    compared_views: int = 16
    """Each view is compared with this many nearest others, so that time stays linear in the number of views."""
    depth_agreement: float = 0.03
    """Relative difference of depth up to which two views see the same surface."""
    confident: float = 0.5
    """Depth of more than this confidence counts as measured where a block would hide it."""
    free_space: float = 0.1
    """A point that is nearer than a measured surface by more than this fraction would hide that surface."""
    coarser: float = 1.1
    """A cell covers a cell of another view if it is at most this many times as large."""
    covered: float = 0.95
    """A block is left out when at least this share of its cells is covered. A share of 0.7 left holes in walls."""
    border: float = 0.1
    """Photos are extended beyond their borders by this share of their longer side, rounded up to whole blocks. That
    photos are extended at all was decided on fortress."""
    border_coarser: int = 4
    """Cells beyond the borders are this many times as large as those of the photos."""
    backdrop_directions: int = 4000
    """Places on the whole sphere of the backdrop. This and the other fields of the backdrop were chosen on fortress,
    dtu106, kermit and fox."""
    backdrop_margin: float = 0.5
    """The backdrop reaches beyond the photos by this share of their longer side."""
    backdrop_behind: float = 1.3
    """The backdrop is so many times as far away as the convex hull of the scene and the cameras."""
    backdrop_behind_cameras: float = 1.2
    """The hull reaches beyond each camera by this factor of its distance from the cameras' centre."""
    backdrop_nearest: float = 2.0
    """Its least distance from the cameras' centre, in distances of the farthest camera from there."""
    backdrop_steepness: float = 1.0
    """By how much the logarithm of its distance may change in a radian. A disc faces the centre. Where the hull falls
    off steeply, it would reach into the scene."""
    backdrop_cells: int = 8
    """Cells along the shorter side of a photo, in which its colours are blurred."""
    backdrop_depths: tuple[float, float] = (0.4, 1.3)
    """Relative to the photo's median depth: nearer and farther pixels count as if they were here."""
    backdrop_fade: float = 0.15
    """Beyond the border of a photo, its colours lose their influence over this share of the longer side."""
    backdrop_least_shown: float = 0.5
    """Where masks leave less than this share of the photos, what is masked is the background, and there is no backdrop.
    Chosen on no set: none has masks."""
    backdrop_opacity: float = 0.99
    """Of each Gaussian of the backdrop."""
    fill: float = 0.7
    """Standard deviation of a prior Gaussian in units of its cell: neighbours just close the surface."""
    thickness: float = 0.2
    """Standard deviation along the normal, in the same units."""
    guessed_opacity: float = 0.6
    """Prior opacity of a cell whose depth has confidence 0."""
    measured_opacity: float = 0.95
    """Prior opacity of a cell whose depth has confidence 1."""
    masked_opacity: float = 0.01
    """Prior opacity of a cell that lies mostly outside the mask."""
    neighbours: int = 4
    """How many rows of each memory, and how many other queries, a query attends to."""
    distance_penalty: float = 2.0
    """Attention logit lost per squared distance, in spacings, between a query and a memory row."""
    near_border: int = 4
    """Within this many blocks of a picture's border, the features of a block state its distance from it."""
    colour_gain: float = 8.0
    """Factor of the colour part of a rendering error. This gain and the next two bring the parts to a size of about 1.
    They were tuned over all six sets of docs/benchmarks.md, so no set is held out from them."""
    opacity_gain: float = 60.0
    """Factor of the opacity part."""
    shape_gain: float = 30.0
    """Factor of the parts for centres and sizes."""
    largest_error: float = 4.0
    """Rendering errors are clamped to ± this after the gains."""
    refining_grey: float = 0.5
    """Rounds of refinement compare the scene with the photos over this grey. The bundled checkpoint was trained with
    this field and the next two."""
    refining_views: int = 12
    """A query reads at most so many views in a round."""
    refining_neighbours: int = 8
    """How many other queries a query reads in a round."""


QUERY_POLICY = QueryPolicy()
"""What every part of this stage uses."""
