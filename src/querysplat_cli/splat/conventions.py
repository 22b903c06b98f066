"""The choices in which rasterisers differ. These are those of the original 3DGS, as gsplat documents them."""

from dataclasses import dataclass

COLOUR_LIMIT = 1e6
"""Evaluated colours are clamped to [0, this], so that wild SH coefficients cannot overflow the blending."""
SCALE_LIMIT = 3e17
"""A Gaussian with a larger scale is culled: the squares of it and of its inverse leave float32's range."""
SHORTEST_QUATERNION = 1e-30
"""A Gaussian whose quaternion is shorter is culled: its direction is lost in rounding, and its gradient overflows."""
CLAMP_MARGIN = 0.3
"""The Jacobian is evaluated inside the frustum, widened by this share of half the field of view."""

MID_GREY = 0.5
"""The background of renders that are compared with each other, and of previews."""
EQUAL_PSNR = 100.0
"""dB of pictures that are equal, or differ by less than float32 resolves, where a score is stored. JSON has no
infinity."""


@dataclass(frozen=True)
class RenderSettings:
    """How Gaussians become pixels.

    `near` and `far` bound camera z, in scene units. A scene is made in those of its median depth, and skies may be
    hundreds of them away. `low_pass` (px²) is added to the diagonal of the 2D covariance; α = min(`alpha_max`,
    opacity·exp(−σ)) and α below `alpha_min` is skipped; a pixel stops before the Gaussian that would bring its
    transmittance to `transmittance_min` or below. `alpha_max` is 0.99 in 3DGS and gsplat 1.6, 0.999 in gsplat 1.5.3.
    """

    near: float = 0.025
    far: float = 1e5
    low_pass: float = 0.3
    alpha_max: float = 0.99
    alpha_min: float = 1 / 255
    transmittance_min: float = 1e-4


RELEASE = RenderSettings(far=125.0, alpha_max=0.999)
"""As the official code renders (with gsplat 1.5.3), over MID_GREY, where `render` draws on the CPU."""
