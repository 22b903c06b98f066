"""The bound of the 3D smoothing filter (`splat/smoothing.py`) during test-time optimisation."""

from dataclasses import replace

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.smoothing import hold_above, sampling
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.variables import Denser, Parametrisation, V


def with_bounded_scales(start: Parametrisation[V], cameras: Cameras) -> Parametrisation[V]:
    """`start`, whose Gaussians are nowhere thinner than the pixels of `cameras`, also after splits.

    Opacities are those of `start`: optimisation adapts them to the scales.
    """
    split = start.densify

    def densify(gaussians: Gaussians, target: RenderingLoss, rounds: int) -> Denser[V]:
        assert split
        denser = split(gaussians, target, rounds)
        bounded = _Bounded(cameras)
        return replace(denser, decode=lambda variables: bounded(denser.decode(variables)))

    bounded = _Bounded(cameras)
    return replace(
        start,
        decode=lambda variables: bounded(start.decode(variables)),
        densify=densify if split else None,
    )


class _Bounded:
    """Bounds the scales of always the same number of Gaussians. Their sampling is found anew now and then."""

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._calls = 0

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        if self._calls % TTO_POLICY.sampled_every == 0:
            # A centre that is not finite has no sampling. The step that made it is undone.
            self._least = torch.nan_to_num(sampling(gaussians.means.detach(), self._cameras).least, 0.0, 0.0)
        self._calls += 1
        return replace(gaussians, scales=hold_above(gaussians.scales, self._least))
