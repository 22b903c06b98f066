"""A small anchored scene of random numbers."""

import torch
from torch import Tensor

from querysplat_cli.model.anchors import Anchors, Neighbours, Reading
from querysplat_cli.model.config import ModelConfig, preset
from querysplat_cli.model.memories import Memories
from querysplat_cli.scene.cameras import Cameras

ROWS = 60
PATCHES = 10
VIEWS = 6
"""VIEWS × PATCHES memory rows."""


def compact(**changes: object) -> ModelConfig:
    return ModelConfig(**{**preset("compact").__dict__, **changes})


def neighbours(seed: int, queries: int, rows: int, near: int = 4, dtype: torch.dtype = torch.float32) -> Neighbours:
    generator = torch.Generator().manual_seed(seed)
    index = torch.stack([torch.randperm(rows, generator=generator)[:near] for _ in range(queries)])
    return Neighbours(index, -2 * torch.rand(queries, near, generator=generator, dtype=torch.float64).to(dtype))


def anchors(config: ModelConfig, queries: int = 20, seed: int = 0) -> Anchors:
    generator = torch.Generator().manual_seed(seed)
    count = config.gaussians_per_query

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Anchors(
        means=normal(queries, count, 3) + torch.tensor([0.0, 0, 4]),
        scales=0.1 * normal(queries, count, 3).exp(),
        quats=torch.nn.functional.normalize(normal(queries, count, 4), dim=-1),
        opacities=torch.rand(queries, count, generator=generator) * 0.9 + 0.05,
        colours=torch.rand(queries, count, 3, generator=generator),
        spacing=0.1 * normal(queries).exp(),
        features=normal(queries, config.anchor_features),
        geometry=neighbours(seed + 1, queries, ROWS),
        appearance=neighbours(seed + 2, queries, ROWS),
        queries=neighbours(seed + 3, queries, queries),
        refinement=torch.zeros(queries, count, 0),
        reading=Reading.none(queries),
    )


def photos(config: ModelConfig, seed: int = 0) -> tuple[tuple[Tensor], Tensor, Cameras]:
    """Features, images and cameras of VIEWS views of 2 × 5 patches."""
    generator = torch.Generator().manual_seed(seed)
    height, width = 2 * config.patch, 5 * config.patch
    features = torch.randn(VIEWS, PATCHES, config.vgm_width, generator=generator)
    images = torch.rand(VIEWS, 3, height, width, generator=generator)
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    w2c = torch.eye(4).repeat(VIEWS, 1, 1)
    w2c[:, :3, 3] = torch.randn(VIEWS, 3, generator=generator)
    return (features,), images, Cameras(w2c, K, height, width)


def memories(config: ModelConfig, seed: int = 0) -> Memories:
    generator = torch.Generator().manual_seed(seed)
    shape = (ROWS, config.heads, config.width // config.heads)
    return Memories(*(torch.randn(shape, generator=generator) for _ in range(4)))
