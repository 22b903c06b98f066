"""Smoothness of guessed depth: where a photo has no edge, the depth of its render shall have none.

What one photo alone shows can lie at any depth and fit that photo, and other places show the difference. So the total
variation of inverse depth is penalised, less where the photo has an edge (the edge-aware smoothness of monocular depth:
Godard et al. 2017, arXiv:1609.03677, section 3.3). Depth that another view confirms is left alone.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.splat.render import Rendering

EDGE = 0.05
"""A step of the photo's brightness, in [0, 1], that lets depth change e times as cheaply."""
LARGEST_STEP = 0.1
"""Steps of inverse depth from pixel to pixel count as no more than this share of the median inverse depth. They are the
borders of things, and should not be rounded off."""
SOLID = 0.5
"""Least alpha of pixels that count. The depth of fainter ones says little."""


def depth_roughness(
    rendering: Rendering,
    photo: Float[Tensor, "1 3 height width"],
    mask: Bool[Tensor, "1 height width"],
    guessed: Bool[Tensor, "1 height width"],
) -> Float[Tensor, ""]:
    """How rough the depth of one rendered view is among `guessed` pixels, where its photo is plain.

    The mean over all pixels of min(|Δ(m/z)|, `LARGEST_STEP`)·exp(−|ΔY|/`EDGE`), added up over both directions and
    multiplied by the longer side, so that the size of the pictures does not matter. z is the depth, m its median, and
    Y the brightness.
    """
    depth, grey = rendering.depth[0], photo[0].mean(0)
    solid = (rendering.alpha[0].detach() > SOLID) & mask[0]
    if not bool(solid.any()):
        return depth.new_zeros(())
    middle = depth.detach()[solid].median()
    nearness = middle / torch.where(solid, depth, middle)
    rough = solid & guessed[0]
    total = depth.new_zeros(())
    for across in (0, 1):
        step = nearness.diff(dim=across).abs().clamp_max(LARGEST_STEP)
        plain = torch.exp(-grey.diff(dim=across).abs() / EDGE)
        count = solid.shape[across] - 1
        both = rough.narrow(across, 0, count) & rough.narrow(across, 1, count)
        total = total + (step * plain * both).mean()
    return max(depth.shape) * total
