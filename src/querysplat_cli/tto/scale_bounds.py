"""The bounds of scales in Gaussian space: no Gaussian thinner than the photos' pixels, and none as large as the scene.

A scene that is written has no giants (`prune/far.py`). Where optimisation made some, they would become smaller at its
end, and show holes and other colours where nothing can adapt any more.
"""

from collections.abc import Callable
from dataclasses import replace

import torch

from querysplat_cli.prune.far import largest_scales
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.smoothing import held, least_scales
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.variables import V


def bounding(decode: Callable[[V], Gaussians], cameras: Cameras | None) -> Callable[[V], Gaussians]:
    """`decode`, and then scales of at least what the 3D smoothing filter makes of points, but not those of giants.

    Gaussians that change from what they are went through the filter already (`splat/smoothing.py`), so they are not
    convolved again. Opacities adapt to the scales by themselves. The bounds are found anew now and then. None bounds
    nothing.
    """
    if cameras is None:
        return decode
    calls, least, largest = 0, torch.zeros(0), torch.zeros(0)

    def decoded(variables: V) -> Gaussians:
        nonlocal calls, least, largest
        gaussians = decode(variables)
        if calls % TTO_POLICY.sampled_every == 0:
            means = gaussians.means.detach()
            # A centre that is not finite has no bounds. The step that made it is undone.
            least = torch.nan_to_num(least_scales(means, cameras), 0.0, 0.0)
            largest = torch.nan_to_num(largest_scales(means, cameras), torch.inf, torch.inf)
        calls += 1
        return replace(gaussians, scales=held(gaussians.scales, least, largest))

    return decoded
