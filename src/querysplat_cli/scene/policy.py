"""Which frames of a film become photos, and what lies over photos."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FilmPolicy:
    """How the frames of films are chosen. Lengths are in longer sides of the picture."""

    step: float = 0.08
    """How far the picture moves from one chosen frame to the next, as the median of tracked corners."""
    fewest_frames: int = 24
    """Where `step` would give fewer frames, it becomes shorter, down to `least_step`."""
    least_step: float = 0.01
    """Frames that are closer than this are taken for the same picture."""
    most_frames: int = 100
    """Most frames that `auto` takes of all films together. Time and memory grow with their number."""
    sharpest_within: float = 0.35
    """A chosen frame is the sharpest within this share of a step around its place."""
    blurred: float = 0.4
    """A frame is blurred when its sharpness is below this share of the median of the frames around it."""
    sharpness_neighbours: int = 15
    """That median is over so many frames to each side."""
    lost_share: float = 0.4
    """Where fewer of the corners can be followed, the picture has moved by a whole step."""
    frames_per_second: float = 15.0
    """Frames that follow each other more quickly are not looked at."""


FILM_POLICY = FilmPolicy()


@dataclass(frozen=True)
class OverlayPolicy:
    """How overlays are found.

    The values were chosen on fox, kermit, fortress and dtu106 with something laid over them, and so that no set of
    docs/data.md has an overlay: far lamps of riverview decided `tied` and `across`.
    """

    size: int = 640
    """Longer side, in pixels, of the pictures that are looked at."""
    fewest: int = 5
    """In fewer photos of one size, edges of a scene stay in place by chance."""
    most: int = 16
    """So many photos of one size are looked at, evenly spaced."""
    copy_size: int = 160
    """Longer side, in pixels, of the pictures in which copies are looked for, where noise and JPEG hardly count."""
    copies: float = 0.92
    """Share of the edges of two pictures from which on one is a copy of the other. Photos of fortress that were saved
    again or shifted by a pixel have 0.95 and more, other photos at most 0.4, and a turntable with 84 % of all edges in
    its surroundings 0.86."""
    least_gradient: float = 6.0
    """Length, in grey levels per pixel, of the mean gradient of an edge that stays in place."""
    deviation: float = 0.5
    """By so many of its lengths a picture's gradient may differ from it."""
    agreeing: float = 0.8
    """Share of the pictures whose gradients differ by less."""
    enough: int = 10
    """In so many pictures, what is half transparent is found, too: there the gradients of a scene seldom agree in
    direction."""
    coherent: float = 0.88
    """Length of the mean gradient, in mean lengths of the gradients, from which on they agree in direction."""
    gap: int = 5
    """Pixels across which edges are connected, such as those of letters."""
    fewest_edges: int = 30
    """Pixels of connected edges, in `enough` pictures. In half as many it takes eight times as many pixels."""
    aside: int = 3
    """Pixels up to which the edges of a part are looked for aside of it."""
    registered: float = 0.75
    """Share of the pictures that a part fits nowhere better than where it is."""
    tied: float = 0.98
    """Of edges across the whole picture, a fit of so much of the best one counts as well: along the straight edge of a
    bar all places fit alike."""
    across: float = 0.95
    """Share of the picture's height or width that such edges reach over."""
    alike: float = 0.6
    """Median over the pictures of the cosine of a part's gradients and their means."""
    most_edges: float = 0.85
    """Share of all edges that an overlay has at most."""
    around: int = 5
    """Side, in pixels, of the square by which edges are widened."""
    same_colour: int = 12
    """Grey levels by which a pixel of a bar or logo differs at most from its median over the pictures."""
    steady: float = 0.6
    """Share of the pictures that do so."""
    before: int = 15
    """Side, in pixels, of a square that fits into what stands before a steady area."""
    gone: float = 0.5
    """Cosine of gradients and mean gradients below which the edges of an area are gone."""
    enclosed: float = 0.7
    """Share of the border of such an area that lies at edges of the overlay."""
    cell: int = 4
    """Side of the cells, in pixels, in whose boxes an overlay is kept."""


OVERLAY_POLICY = OverlayPolicy()
