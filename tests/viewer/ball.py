"""A scene for the browser."""

import torch

from querysplat_cli.scene.gaussians import Gaussians

COUNT = 400


def made_gaussians() -> Gaussians:
    """Coloured ellipsoids in a ball of radius 1, with SH of degree 2, none of them see-through."""
    some = torch.Generator().manual_seed(3)
    return Gaussians(
        torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=some), dim=1)
        * torch.rand(COUNT, 1, generator=some),
        torch.randn(COUNT, 4, generator=some),
        0.02 + 0.08 * torch.rand(COUNT, 3, generator=some),
        0.3 + 0.6 * torch.rand(COUNT, generator=some),
        0.4 * torch.randn(COUNT, 9, 3, generator=some),
    )
