"""The bound of the 3D smoothing filter (`splat/smoothing.py`) in Gaussian space."""

from collections.abc import Callable
from dataclasses import replace

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.smoothing import hold_above, least_scales
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.variables import V


def bounding(decode: Callable[[V], Gaussians], cameras: Cameras | None) -> Callable[[V], Gaussians]:
    """`decode`, and then scales of at least what the filter makes of points. None bounds nothing.

    Gaussians that change from what they are went through the filter already, so they are not convolved again.
    Opacities adapt to the scales by themselves. The sampling is found anew now and then.
    """
    if cameras is None:
        return decode
    calls, least = 0, torch.zeros(0)

    def decoded(variables: V) -> Gaussians:
        nonlocal calls, least
        gaussians = decode(variables)
        if calls % TTO_POLICY.sampled_every == 0:
            # A centre that is not finite has no sampling. The step that made it is undone.
            least = torch.nan_to_num(least_scales(gaussians.means.detach(), cameras), 0.0, 0.0)
        calls += 1
        return replace(gaussians, scales=hold_above(gaussians.scales, least))

    return decoded
