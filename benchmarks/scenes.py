"""Random and single Gaussians, and cameras that see them: scenes on which the splatter is tested."""

import math
from dataclasses import fields

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians

import torch
from torch import Tensor

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def camera(height: int, width: int, *, field_of_view: float = 50.0, views: int = 1) -> Cameras:
    """Cameras on a small arc that look at (0, 0, 4); `field_of_view` in degrees, along the longer side."""
    focal = max(height, width) / (2 * math.tan(math.radians(field_of_view) / 2))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    w2c = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    for v in range(views):
        angle = 0.15 * v
        turn = torch.tensor(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]],
            dtype=torch.float64,
        )
        target = torch.tensor([0.0, 0, 4], dtype=torch.float64)
        w2c[v, :3, :3], w2c[v, :3, 3] = turn, target - turn @ target
    return Cameras(w2c, K.repeat(views, 1, 1), height, width)


def cloud(
    seed: int,
    count: int,
    cameras: Cameras,
    *,
    degree: int = 1,
    pixels: float = 2.5,
    opacity: tuple[float, float] = (0.05, 0.95),
) -> Gaussians:
    """Float64 Gaussians all over the first view, z in [2, 6], about `pixels` of standard deviation."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    focal = float(cameras.K[0, 0, 0])
    z = 2 + 4 * uniform(count)
    spread = torch.tensor([cameras.width, cameras.height], dtype=torch.float64) / focal
    xy = (uniform(count, 2) - 0.5) * 1.2 * spread * z[:, None]
    return Gaussians(
        torch.cat([xy, z[:, None]], 1),
        normal(count, 4),
        torch.exp(0.5 * normal(count, 3)) * (pixels / focal * z[:, None]),
        opacity[0] + (opacity[1] - opacity[0]) * uniform(count),
        0.4 * normal(count, (degree + 1) ** 2, 3),
    )


def single(**changes: object) -> Gaussians:
    """One moderate Gaussian in front of the camera; `changes` replace the rows of the fields that they name."""
    rows: dict[str, object] = {
        "means": [0.0, 0.0, 3.0],
        "quats": [1.0, 0.0, 0.0, 0.0],
        "scales": [0.3, 0.3, 0.3],
        "opacities": 0.7,
        "sh": [[0.5, 0.1, -0.2]],
    }
    return Gaussians(**{name: torch.tensor([value], dtype=torch.float64) for name, value in (rows | changes).items()})


def stacked(*parts: Gaussians) -> Gaussians:
    return Gaussians(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Gaussians)})
