"""Which frames of a film become photos."""

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
