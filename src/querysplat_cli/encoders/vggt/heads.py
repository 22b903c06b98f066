"""VGGT's camera and depth heads (docs/reference/official-checkpoint.md)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.encoders.transformer.blocks import Block, Mlp
from querysplat_cli.encoders.transformer.dpt import Pyramid, Scratch, resize, with_position


class CameraHead(nn.Module):
    """Camera tokens of all views to pose encodings, in a fixed number of refinements."""

    def __init__(self, inputs: int, heads: int = 16, blocks: int = 4, refinements: int = 4) -> None:
        super().__init__()
        self.refinements = refinements
        self.token_norm = nn.LayerNorm(inputs)
        self.trunk = nn.Sequential(*(Block(inputs, heads, normed=False, masked=False) for _ in range(blocks)))
        self.trunk_norm = nn.LayerNorm(inputs)
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, 9))
        self.embed_pose = nn.Linear(9, inputs)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(inputs, 3 * inputs))
        self.adaln_norm = nn.LayerNorm(inputs, eps=1e-6, elementwise_affine=False)
        self.pose_branch = Mlp(inputs, inputs // 2, 9)

    def forward(self, camera: Float[Tensor, "views inputs"]) -> Float[Tensor, "refinements views 9"]:
        """The encoding after each refinement. The last one is the result."""
        tokens, raw, found = self.token_norm(camera)[None], None, []
        for _ in range(self.refinements):
            pose = self.empty_pose_tokens if raw is None else raw
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(pose)).chunk(3, -1)
            modulated = tokens + gate * (self.adaln_norm(tokens) * (1 + scale) + shift)
            change = self.pose_branch(self.trunk_norm(self.trunk(modulated)))
            raw = change if raw is None else raw + change
            found.append(torch.cat([raw[..., :7], F.relu(raw[..., 7:])], -1)[0])
        return torch.stack(found)


class DepthScratch(Scratch):
    """With the last convolutions.

    The ReLUs of the release work in place, so its skip connections add the positive part of the input (`rectified`).
    """

    def __init__(self, levels: Sequence[int], channels: int) -> None:
        super().__init__(levels, channels, rectified=True)
        self.output_conv1 = nn.Conv2d(channels, channels // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(nn.Conv2d(channels // 2, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 2, 1))


class DepthHead(Pyramid):
    """Patch tokens of the cached layers to depth (camera z) and confidence."""

    scratch: DepthScratch

    def __init__(
        self, inputs: int, patch: int, channels: int = 256, levels: Sequence[int] = (256, 512, 1024, 1024)
    ) -> None:
        super().__init__(inputs, levels, DepthScratch(levels, channels))
        self.patch = patch

    def forward(
        self, layers: Sequence[Float[Tensor, "views patches inputs"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "views height width"], Float[Tensor, "views height width"]]:
        """Depth, and confidence above 1, at the size of the picture. `grid` is (rows, columns) of patches."""
        aspect = grid[1] / grid[0]
        levels = self.levels(layers, grid, aspect)
        *_, finest = self.fuse(levels, (2 * levels[0].shape[-2], 2 * levels[0].shape[-1]))
        full = resize(self.scratch.output_conv1(finest), (grid[0] * self.patch, grid[1] * self.patch))
        depth, confidence = self.scratch.output_conv2(with_position(full, aspect)).unbind(1)
        return depth.exp(), 1 + confidence.exp()
