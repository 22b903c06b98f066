"""Defaults of exposure correction: when photos disagree, and how their colour transforms are fitted."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExposurePolicy:
    """Thresholds and weights of `--exposure auto`.

    Chosen on fortress, dtu106, kermit, fox, and on fox with made changes of exposure and white balance.
    """

    disagreement: float = 0.055
    """`auto` corrects where the transform of a photo differs from those of the photos beside it by so much of a
    channel's range, root mean square. Measured: fortress 0.005, kermit 0.010, dtu106 0.036, fox 0.042, fox with made
    changes 0.091. Smaller differences, and those that follow the camera's place, are left to the scene. The colours of
    its surfaces and its directional colours show them in the pictures between the photos, too."""
    ridge: float = 0.01
    """Pull of a transform towards the identity, as a share of the weight of its observations. Colours have squares of
    about 0.25, so gains hardly feel it. It decides what the observed colours leave open, such as the mixing of channels
    by grey surfaces. Colour-corrected, fox with made changes has 22.40 dB held out with 0.01, and 22.35 with 0.001."""
    error_floor: float = 0.02
    """Observations are weighted by the inverse of their error plus this floor, so that surfaces that were matched
    wrongly count little."""
    saturated: float = 0.97
    """Pixels with a brighter channel may be clipped, and say nothing about the exposure."""
    white: float = 0.995
    """A channel from here on is clipped, and one below 1 less this: the scene may be brighter, or darker."""
    points_per_view: int = 1000
    """Pixels of each view, on a grid, that are looked up in other views."""
    most_points: int = 50_000
    """Of all views together."""
    compared_views: int = 8
    """The nearest other views, in which each pixel is looked up."""
    fewest_observations: int = 30
    """A photo with fewer keeps the identity."""
    iterations: int = 20
    """Of alternating between the colours of points and the transforms of photos."""
    memory: float = 0.5
    """During optimisation, the share of earlier renders in the fit of a photo's transform."""
    pace: float = 0.5
    """During optimisation, the share of the way from a photo's transform to its fit that each render of it goes."""
    every_pixel: int = 3
    """Fits during optimisation use one pixel of so many in each direction."""


EXPOSURE_POLICY = ExposurePolicy()
