"""Scenes that several tests of test-time optimisation share."""

import torch

from querysplat_cli.scene.gaussians import Gaussians


def wall(side: int, *, size: float, opacity: float, seed: int = 0) -> Gaussians:
    """`side` × `side` round Gaussians of random colours in a plane two units away.

    `size` times 1/`side` is their standard deviation; their centres are 1.8/`side` apart.
    """
    line = (torch.arange(side) + 0.5) / side * 1.8 - 0.9
    y, x = torch.meshgrid(line, line, indexing="ij")
    n = side * side
    return Gaussians(
        means=torch.stack([x.ravel(), y.ravel(), torch.full((n,), 2.0)], 1),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        scales=torch.full((n, 3), size / side),
        opacities=torch.full((n,), opacity),
        sh=torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1,
    )
