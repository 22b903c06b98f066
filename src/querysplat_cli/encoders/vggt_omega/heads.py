"""VGGT-Omega's camera and depth heads (docs/reference/official-checkpoint.md)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.encoders.transformer.blocks import Block
from querysplat_cli.encoders.transformer.dpt import Pyramid, Scratch, with_position

LEAST_FIELD = 0.01
"""The smallest field of view that the camera head can predict, in radians."""
SHUFFLE = 4
"""Each pixel of the fused map becomes so many pixels of depth a side."""


class CameraHead(nn.Module):
    """Camera and register tokens of all views, as one sequence, to a pose encoding of each view."""

    def __init__(self, inputs: int, heads: int = 16, blocks: int = 4) -> None:
        super().__init__()
        self.token_norm = nn.LayerNorm(inputs)
        self.trunk = nn.Sequential(*(Block(inputs, heads, normed=False, masked=True) for _ in range(blocks)))
        self.trunk_norm = nn.LayerNorm(inputs)
        self.camera_branch = nn.Sequential(nn.Linear(inputs, inputs // 2), nn.GELU(), nn.Linear(inputs // 2, 9))

    def forward(self, special: Float[Tensor, "views specials inputs"]) -> Float[Tensor, "views 9"]:
        sequence = self.token_norm(special).flatten(0, 1)[None]
        camera = self.trunk(sequence)[0].unflatten(0, special.shape[:2])[:, 0]
        return activate_pose(self.camera_branch(self.trunk_norm(camera)))


def activate_pose(raw: Float[Tensor, "views 9"]) -> Float[Tensor, "views 9"]:
    """The encoding with positive fields of view; the other numbers are unchanged."""
    return torch.cat([raw[:, :7], F.relu(raw[:, 7:]) + LEAST_FIELD], 1)


class DepthHead(Pyramid):
    """Patch tokens of the cached layers to depth (camera z) and confidence."""

    def __init__(self, inputs: int, channels: int = 256, levels: Sequence[int] = (256, 512, 1024, 1024)) -> None:
        super().__init__(inputs, levels, Scratch(levels, channels, rectified=False))
        self.proj = nn.Conv2d(channels, SHUFFLE**2, 1)
        self.proj_conf = nn.Conv2d(channels, SHUFFLE**2, 1)

    def forward(
        self, layers: Sequence[Float[Tensor, "views patches inputs"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "views height width"], Float[Tensor, "views height width"]]:
        """Depth, and confidence above 1, at the size of the picture. `grid` is (rows, columns) of patches."""
        aspect = grid[1] / grid[0]
        levels = self.levels(layers, grid, aspect)
        *_, finest = self.fuse(levels, (levels[0].shape[-2], levels[0].shape[-1]))
        finest = with_position(finest, aspect)
        depth, confidence = (F.pixel_shuffle(each(finest), SHUFFLE)[:, 0] for each in (self.proj, self.proj_conf))
        return depth.exp(), 1 + confidence.exp()
