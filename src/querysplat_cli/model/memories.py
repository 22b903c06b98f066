"""What the queries read: a geometry memory from the VGM's layers, an appearance memory from the photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.runtime.precision import Conv2d, LayerNorm, Linear
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.fit import normalised
from querysplat_cli.scene.tensor_dataclass import TensorDataclass


@dataclass(frozen=True)
class Memory:
    """What one decoder reads: a key, already normed, and a value for each row and head.

    With `neighbours`, each query reads only the rows that they name for it; without, it reads all.
    """

    keys: Float[Tensor, "memory heads channels"]
    values: Float[Tensor, "memory heads channels"]
    neighbours: Neighbours | None = None


@dataclass(frozen=True)
class Memories(TensorDataclass):
    """Keys and values of both branches: by default the only variables of test-time optimisation."""

    geometry_keys: Float[Tensor, "geometry heads channels"]
    geometry_values: Float[Tensor, "geometry heads channels"]
    appearance_keys: Float[Tensor, "appearance heads channels"]
    appearance_values: Float[Tensor, "appearance heads channels"]

    def geometry(self, neighbours: Neighbours | None = None) -> Memory:
        """What the geometry decoder reads."""
        return Memory(self.geometry_keys, self.geometry_values, neighbours)

    def appearance(self, neighbours: Neighbours | None = None) -> Memory:
        """What the appearance decoder reads."""
        return Memory(self.appearance_keys, self.appearance_values, neighbours)


@dataclass(frozen=True)
class Features(TensorDataclass):
    """Tokens of both branches before they become keys and values: what section 3.5 of the paper optimises."""

    geometry: Float[Tensor, "geometry width"]
    appearance: Float[Tensor, "appearance width"]


def attended_rows(
    features: Features, anchors: Anchors
) -> tuple[Features, Anchors, tuple[Int[Tensor, "geometry"], Int[Tensor, "appearance"]]]:
    """Only the rows that some anchor attends to, the anchors with these rows renumbered, and their numbers before.

    Decoding gives the same scene. The rows left out would never receive a gradient.
    """
    geometry, near_geometry = anchors.geometry.index.unique(return_inverse=True)
    appearance, near_appearance = anchors.appearance.index.unique(return_inverse=True)
    renumbered = replace(
        anchors,
        geometry=replace(anchors.geometry, index=near_geometry),
        appearance=replace(anchors.appearance, index=near_appearance),
    )
    return Features(features.geometry[geometry], features.appearance[appearance]), renumbered, (geometry, appearance)


TOKENS_AT_ONCE = 65536
"""Tokens that are projected at once: with hundreds of views, the intermediate results of all would fill a GPU."""


class KeyValue(nn.Module):
    """Tokens to keys and values, once for all blocks of a decoder: norm, projection, and a norm of each head's keys."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = LayerNorm(width)
        self.proj = Linear(width, 2 * width)
        self.k_norm = LayerNorm(width // heads)

    def forward(
        self, tokens: Float[Tensor, "tokens width"]
    ) -> tuple[Float[Tensor, "tokens heads channels"], Float[Tensor, "tokens heads channels"]]:
        parts = [self.proj(self.norm(some)).unflatten(-1, (2, self.heads, -1)) for some in tokens.split(TOKENS_AT_ONCE)]
        keys = torch.cat([self.k_norm(part[:, 0]).to(part.dtype) for part in parts])
        return keys, torch.cat([part[:, 1] for part in parts])


class LayerMixer(nn.Module):
    """Cached VGM layers to one row of tokens for each token of each view (paper, section 3.1).

    The patches of all layers are mixed with weights that an MLP computes from a learned eye token. Camera and register
    tokens are those of the last layer. A single layer is taken as it is: it may be a mixture that the encoder has
    already made with the same weights.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.special_tokens = config.special_tokens
        self.proj = nn.Identity() if config.vgm_width == config.width else nn.Linear(config.vgm_width, config.width)
        if config.has_eye:
            self.weigh = nn.Sequential(
                nn.LayerNorm(config.width),
                nn.Linear(config.width, config.width // 2),
                nn.GELU(),
                nn.Linear(config.width // 2, config.mixed_layers),
            )
        self.norm = LayerNorm(config.width)

    def weights(self, eye: Float[Tensor, "1 width"]) -> Float[Tensor, "layers"]:
        """Weights of the layers; they depend on the checkpoint alone."""
        return self.weigh(eye).softmax(-1)[0]

    def forward(
        self, layers: Sequence[Float[Tensor, "views tokens channels"]], eye: Float[Tensor, "1 width"] | None
    ) -> Float[Tensor, "views*tokens width"]:
        start, tokens = self.special_tokens, layers[-1]
        if eye is not None and len(layers) > 1:
            weights = self.weights(eye)
            patches = weights[0] * layers[0][:, start:]
            for weight, layer in zip(weights[1:], layers[1:], strict=True):
                patches = patches + weight * layer[:, start:]
            tokens = torch.cat([tokens[:, :start], patches], 1)
        return self.norm(self.proj(tokens)).flatten(0, 1)


class PhotoEmbedding(nn.Module):
    """Photos and their viewing rays to patch tokens, each normed before the sum (paper, section 3.1)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.patch = config.patch
        self.colour = Conv2d(3, config.width, config.patch, config.patch)
        self.colour_norm = LayerNorm(config.width)
        self.rays = Conv2d(6, config.width, config.patch, config.patch)
        self.rays_norm = LayerNorm(config.width)

    def forward(
        self, images: Float[Tensor, "views 3 height width"], cameras: Cameras
    ) -> Float[Tensor, "patches channels"]:
        colour = self.colour(normalised(images)).flatten(2).mT
        rays = self.rays(plucker_rays(cameras).to(images)).flatten(2).mT
        return (self.colour_norm(colour) + self.rays_norm(rays)).flatten(0, 1)


def plucker_rays(cameras: Cameras) -> Float[Tensor, "views 6 height width"]:
    """Moment o × d and unit world direction d of the ray through every pixel centre."""
    with torch.autocast(cameras.w2c.device.type, enabled=False):
        return _plucker_rays(cameras)


def _plucker_rays(cameras: Cameras) -> Float[Tensor, "views 6 height width"]:
    fx, fy, cx, cy = (part[:, None, None] for part in cameras.intrinsics)
    columns, rows = (torch.arange(size).to(cameras.K) + 0.5 for size in (cameras.width, cameras.height))
    x = (columns - cx) / fx
    y = (rows[:, None] - cy) / fy
    x, y = torch.broadcast_tensors(x, y)
    # `F.normalize` takes four times as long across planes.
    local = torch.stack([x, y, torch.ones_like(x)], 1) / (x * x + y * y + 1).sqrt()[:, None]
    c2w = cameras.c2w
    direction = torch.einsum("vij,vjhw->vihw", c2w[:, :3, :3], local)
    origin = c2w[:, :3, 3, None, None].expand_as(direction)
    return torch.cat([torch.linalg.cross(origin, direction, dim=1), direction], 1)
