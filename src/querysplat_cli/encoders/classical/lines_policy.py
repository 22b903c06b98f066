"""How straight lines tell a focal length."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LinesPolicy:
    """Which lines are looked for, how exact they are, and which focal lengths are tried.

    Lengths are in longer sides of the picture. The values were set by what LSD measures, and not fitted; `told_spread`
    alone was chosen (docs/tried.md).
    """

    size: int = 800
    """Longer side of the pictures, in pixels, in which lines are looked for."""
    shortest: float = 0.025
    """Length of the shortest lines that count."""
    most: int = 400
    """So many lines count, the longest."""
    fewest: int = 10
    """Fewer lines say nothing."""
    longest: float = 0.2
    """Each line counts by its length, but longer ones as this."""
    angle_spread: float = 0.006
    """Standard deviation, in radians, of the direction of a long line: edges of real things are not quite parallel."""
    end_spread: float = 0.0006
    """That of the place of a line's end, which turns short lines more."""
    stray: float = 0.4
    """Share of the lines that run in any direction."""
    bend: float = 0.3
    """The distortion k1 stays between this and its negative."""
    reach: float = 3.0
    """Focal lengths are tried so many standard deviations of the usual one to either side."""
    focals: int = 32
    """So many, in equal ratios."""
    triples: int = 200
    """Lines are drawn by threes so often for each focal length: two meet in a vanishing point, and the third one runs
    at a right angle to it."""
    candidates: int = 3
    """So many of these frames are adjusted."""
    annealing: tuple[float, ...] = (3.0, 2.0, 1.0, 1.0, 1.0)
    """Spreads of the steps of an adjustment, in those of the lines."""
    largest_turn: float = 0.2
    """Radians that a step may turn a frame by."""
    told_spread: float = 0.15
    """Lines tell a focal length whose logarithm then has a smaller standard deviation. Where they leave a larger one,
    most of what they say is chance, and the usual focal length stays: no pair of fox, kermit, dtu106 and fortress has
    less, and of pairs of made-up rooms, streets and tables 77, 50 and 55 %."""
    least_spread: float = 0.03
    """The logarithm of the focal length has at least this standard deviation: the middle of a photo is not quite that
    of its lens."""


LINES_POLICY = LinesPolicy()
