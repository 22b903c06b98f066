"""Scenes that several tests of test-time optimisation share."""

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render


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


def photo_of_wall(size: int) -> tuple[Views, Cameras]:
    """One photo of a fine wall, as uint8, and its camera."""
    K = torch.tensor([[[1.25 * size, 0, size / 2], [0, 1.25 * size, size / 2], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], K, size, size)
    images = (render(wall(12, size=1.2, opacity=0.97), cameras).colour.clamp(0, 1) * 255).round().to(torch.uint8)
    return Views(images, torch.ones(1, size, size, dtype=torch.bool), ("a",), ((size, size),)), cameras
