"""The coverage loss: between photos that are far apart, optimisation may not open holes that no photo shows."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import interpolate
from querysplat_cli.splat.render import render
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import LossAndGradient, gradient_of


@dataclass(frozen=True)
class CoverageLoss:
    """Cameras between the input views, and the alpha of their pictures before the scene was optimised."""

    cameras: Cameras
    alphas: Float[Tensor, "views height width"]

    @classmethod
    def of(cls, gaussians: Gaussians, cameras: Cameras) -> "CoverageLoss":
        """The coverage of a scene between at least two views, in their order."""
        step = TTO_POLICY.cameras_between + 1
        path = interpolate(cameras.to("cpu"), step * (len(cameras) - 1) + 1).to(cameras.w2c.device)
        between = path[[i for i in range(len(path)) if i % step]]
        with torch.no_grad():
            alphas = [render(gaussians, between[[view]]).alpha for view in range(len(between))]
        return cls(between, torch.cat(alphas))

    def add_to(self, here: LossAndGradient, gaussians: Gaussians, step: int) -> LossAndGradient:
        """`here` with the gradient of the coverage that one camera, in turn, has lost.

        The loss is `TtoPolicy.coverage_weight` times the mean of max(0, α₀ − α).
        """
        view = step % len(self.cameras)
        leaves = gaussians.map(lambda part: part.detach().requires_grad_())
        alpha = render(leaves, self.cameras[[view]]).alpha[0]
        (TTO_POLICY.coverage_weight * (self.alphas[view] - alpha).relu().mean()).backward()
        summed = [a + gradient_of(b) for a, b in zip(here.gradient.tensors(), leaves.tensors(), strict=True)]
        return replace(here, gradient=Gaussians(*summed))
