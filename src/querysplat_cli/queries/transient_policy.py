"""What decides which parts of photos are taken for transients."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TransientPolicy:
    """Thresholds of `transients.py`.

    They were chosen on fortress, dtu106, kermit and fox, as they are and with made-up people drawn over half of the
    photos (docs/tried.md).
    """

    stride: int = 2
    """Every so many rows and columns a pixel is looked at."""
    measured: tuple[float, float] = (0.005, 0.995)
    """Quantiles of the measured depths of a view that count as its nearest and farthest ones."""
    nearer: float = 4.0
    """Rays are searched from the nearest one over this factor: what stands before all of that is often not measured."""
    farther: float = 1.4
    """They are searched to the farthest one times this factor."""
    step: float = 1.05
    """Depth grows by this factor from one place on a ray to the next."""
    same_depth: float = 0.05
    """Relative difference up to which a place lies on a surface that another view measured. A place that is nearer by
    more lies in the free space in front of it."""
    agreeing: float = 0.8
    """A pixel whose own depth has at least this confidence shows what other views show, whatever its colour: shadows
    and reflections move over it."""
    same_colour: float = 0.1
    """Largest difference of a channel, of 1, up to which a pixel shows a surface that another view measured."""
    perhaps: float = 0.2
    """The same where the other view measured nothing: the pixel may show what is there."""
    smoothed: float = 1 / 128
    """Colours are means over squares that reach so far to each side, as a share of the picture's longer side."""
    fewest_surfaces: int = 3
    """So many views have measured, in other colours, what a pixel ought to show. With 2, more of the people are found,
    and wallpaper of fox is left out that shines in one photo: 12 photos lose 0.35 dB."""
    superpixel: float = 1 / 40
    """Side of a superpixel, as a share of the picture's longer side. One is judged as a whole."""
    pure: float = 0.7
    """Share of the judged pixels of a superpixel that show what was not there for the other views."""
    covered: float = 0.3
    """And the share of all its pixels, from which on it is a part of a transient."""
    least: float = 0.004
    """Share of a picture below which connected pixels are left as they are."""
    around: float = 0.1
    """It is grown by at most this share of the picture's longer side."""
    doubtful: float = 0.3
    """It grows into superpixels of whose pixels a smaller share shows what other views show,"""
    touched: float = 0.05
    """and a larger share than this does not. Without this, a twentieth of what is around people on fox goes, too."""
    rounds: int = 3
    """Iterations of GrabCut, which finds its edges."""
    edge: int = 2
    """Pixels around it that are left out with it: its colours are mixed in there."""


TRANSIENT_POLICY = TransientPolicy()
