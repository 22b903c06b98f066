"""The depth of the surface that a view shows, where mist in front of it and strays behind it do not count.

The mean depth of a pixel is drawn away by every faint Gaussian on its ray. Here the Gaussians are drawn up to one depth
after the other. The surface is where half of the coverage is reached, and its depth is the mean around there.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.quantiles import picked
from querysplat_cli.splat.conventions import RenderSettings
from querysplat_cli.splat.render import Rendering, render


@dataclass(frozen=True)
class SurfaceDepth:
    """Camera z [height, width], and the share from 0 to 1 of a pixel that Gaussians near this depth cover."""

    depth: Float[Tensor, "height width"]
    confidence: Float[Tensor, "height width"]


LEVELS = 32
"""Depths up to which Gaussians are drawn; neighbours have the same ratio."""
AROUND = 1
"""Steps between levels on either side of that with the median, whose Gaussians count as near it."""


@torch.no_grad()
def surface_depth(gaussians: Gaussians, camera: Cameras, picture: Rendering) -> SurfaceDepth:
    """Of the `picture` of one view. Where nothing is covered, depth and confidence are 0."""
    settings = RenderSettings()
    z = camera.local(gaussians.means, 0)[:, 2]
    z = z[(z > settings.near) & (z < settings.far)]
    if not len(z):
        return SurfaceDepth(torch.zeros_like(picture.depth[0]), torch.zeros_like(picture.alpha[0]))
    first, last = picked(z, 0.001, 0.999).tolist()
    levels = torch.logspace(0, 1, LEVELS - 1, base=1.001 * last / first) * first
    coverage, weighted = [torch.zeros_like(picture.alpha[0])], [torch.zeros_like(picture.alpha[0])]
    for level in levels.tolist():
        drawn = render(gaussians, camera, settings=replace(settings, far=min(level, settings.far)))
        coverage.append(drawn.alpha[0])
        weighted.append(drawn.alpha[0] * drawn.depth[0])
    coverage.append(picture.alpha[0])
    weighted.append(picture.alpha[0] * picture.depth[0])
    alpha, sums = torch.stack(coverage), torch.stack(weighted)
    median = (alpha < alpha[-1] / 2).sum(0)  # the first level that reaches half of the coverage
    above, below = (median + AROUND).clamp_max(LEVELS), (median - 1 - AROUND).clamp_min(0)
    near = alpha.gather(0, above[None])[0] - alpha.gather(0, below[None])[0]
    depth = (sums.gather(0, above[None]) - sums.gather(0, below[None]))[0] / near.clamp_min(1e-10)
    return SurfaceDepth(torch.where(near > 0, depth, 0.0), near.clamp_min(0))
