"""The rendering loss of many views, and its gradient, in the memory of a few."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import RenderSettings, render
from querysplat_cli.splat.similarity import photometric_loss


@dataclass(frozen=True)
class RenderingLoss:
    """L1 + 0.2·D-SSIM between renders and photos (paper, section 3.3; the LPIPS term needs its weights).

    Views are rendered `chunk` at a time. The loss of a set of views is the mean of the views' losses, so
    that how they are cut into chunks changes neither it nor its gradient beyond rounding.
    """

    views: Views
    cameras: Cameras
    background: Tensor | None = None
    settings: RenderSettings = field(default_factory=RenderSettings)
    chunk: int = 4

    def value(self, gaussians: Gaussians, chosen: list[int]) -> float:
        """The loss over the views `chosen`."""
        with torch.no_grad():
            return sum(float(part) for part in self._parts(gaussians, chosen))

    def value_and_gradient(self, gaussians: Gaussians, chosen: list[int]) -> tuple[float, Gaussians]:
        """The loss over the views `chosen`, and its gradient with respect to every Gaussian parameter."""
        leaves = gaussians.map(lambda field: field.detach().requires_grad_())
        total = 0.0
        for part in self._parts(leaves, chosen):
            part.backward()
            total += float(part.detach())
        return total, leaves.map(lambda field: torch.zeros_like(field) if field.grad is None else field.grad)

    def _parts(self, gaussians: Gaussians, chosen: list[int]) -> Iterator[Tensor]:
        for start in range(0, len(chosen), self.chunk):
            some = chosen[start : start + self.chunk]
            picture = render(gaussians, self.cameras[some], background=self.background, settings=self.settings)
            loss = photometric_loss(picture.colour, self.views.images[some], self.views.masks[some])
            yield loss * (len(some) / len(chosen))
