"""Numbers that decide what training scenes are made of, where a configuration file does not give them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingPolicy:
    """Choices that every training shares. None was tuned on a photo set: training scenes are procedural or the user's.

    A pair is the lowest and the highest value of a uniform draw.
    """

    film_frames: int = 150
    """Most frames that are used of a video. They are evenly spaced."""
    longest_side: int = 1600
    """Pixels to which larger photos and frames are reduced when they are read."""
    room_share: float = 0.5
    """Share of the procedural scenes that are rooms. The others are in the open."""
    portrait_share: float = 0.25
    """Share of the procedural captures that are taller than wide."""
    aspect: tuple[float, float] = (0.6, 0.8)
    """Shorter side of a procedural photo, relative to the longer one."""
    clearance: float = 0.25
    """Metres between a camera and the nearest surface, at least."""
    path_tries: int = 200
    """Camera paths that are drawn in a procedural scene before it is given up."""
    scene_tries: int = 50
    """Procedural scenes that are drawn before a capture is given up."""
    sample_tries: int = 20
    """Scenes in a row that may give no sample before a training without a cache stops."""
    exposures: tuple[float, ...] = (0.0, 0.02, 0.08)
    """Standard deviation of the logarithm of the gain from photo to photo. Each capture draws one of these."""
    varied_exposures: tuple[float, ...] = (0.0, 0.02, 0.08, 0.2)
    """The same for varied scenes."""
    white_balances: tuple[float, ...] = (0.0, 0.01, 0.05)
    """In varied scenes, standard deviation of the logarithm of each channel's gain from photo to photo."""
    dark_share: float = 0.6
    """In varied scenes, the largest share of things that are dark; each scene draws its own below it."""
    darkness: tuple[float, float] = (0.04, 0.3)
    """Brightness of dark things, relative to the usual sRGB colours."""
    glossy_share: float = 0.5
    """In varied scenes, the largest share of things that are glossy."""
    gloss: tuple[float, float] = (0.03, 0.5)
    """Share of the light that glossy things reflect like a mirror, seen straight on."""
    fence_share: float = 0.4
    """Share of the varied scenes in the open that have a fence of thin bars."""
    varied_noise: tuple[float, float] = (0.0, 0.05)
    """As `noise`, in varied scenes."""
    varied_blur: tuple[float, float] = (0.3, 1.2)
    """As `blur`, in varied scenes."""
    noise: tuple[float, float] = (0.0, 0.02)
    """Standard deviation of a white pixel's noise, in [0, 1]; it falls with the square root of the brightness."""
    blur: tuple[float, float] = (0.3, 0.8)
    """Standard deviation of the Gaussian blur, in pixels."""
    jpeg_quality: tuple[int, int] = (80, 97)
    """JPEG quality of a photo, both ends included."""
    query_noise: float = 0.01
    """Standard deviation of the noise on copied queries; learned queries themselves start with as much."""


TRAINING_POLICY = TrainingPolicy()
