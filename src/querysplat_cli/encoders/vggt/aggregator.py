"""VGGT's aggregator: DINOv2 with registers, then alternating attention (docs/reference/official-checkpoint.md)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.encoders.transformer.aggregator import Aggregator
from querysplat_cli.encoders.transformer.blocks import Block, PatchConvolution
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.rotary import Rotation, split_rotation
from querysplat_cli.runtime.precision import LayerNorm

VIT_EPS = 1e-6
"""The epsilon of the patch encoder's layer norms."""


class PatchEncoder(nn.Module):
    """Patch tokens of each view alone, with a learned grid of positions. Class and register tokens stay inside."""

    def __init__(self, config: VgmConfig) -> None:
        super().__init__()
        width, self.side = config.width, config.pretrained_image // config.patch
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + self.side**2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, config.storage_tokens, width))
        # In the checkpoint, but unused.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = PatchConvolution(width, config.patch)
        self.blocks = nn.ModuleList(
            Block(width, config.heads, normed=False, masked=False, eps=VIT_EPS) for _ in range(config.vit_depth)
        )
        self.norm = LayerNorm(width, eps=VIT_EPS)

    def forward(self, images: Float[Tensor, "views 3 height width"]) -> Float[Tensor, "views patches channels"]:
        """Patch tokens of normalised images."""
        patches = self.patch_embed.proj(images).to(self.cls_token.dtype)
        placed = patches.flatten(2).mT + self.positions(*patches.shape[-2:])
        first = self.cls_token + self.pos_embed[:, :1]
        before = torch.cat([first, self.register_tokens], 1).expand(len(images), -1, -1)
        tokens = torch.cat([before, placed], 1)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)[:, before.shape[1] :]

    def positions(self, rows: int, columns: int) -> Float[Tensor, "1 patches channels"]:
        """The learned grid of positions, resized where the patch grid differs from that of the training."""
        grid = self.pos_embed[:, 1:]
        if (rows, columns) == (self.side, self.side):
            return grid
        square = grid.mT.unflatten(2, (self.side, self.side))
        return F.interpolate(square, (rows, columns), mode="bicubic", antialias=True).flatten(2).mT


class VggtAggregator(Aggregator):
    """Patch positions enter the attention inside views and between them."""

    rotate_across = True

    def __init__(self, config: VgmConfig) -> None:
        super().__init__(config, masked=False)
        self.patch_embed = PatchEncoder(config)
        self.global_blocks = self.make_blocks(masked=False)

    def across_blocks(self) -> nn.ModuleList:
        return self.global_blocks

    def rotation(self, rows: int, columns: int) -> Rotation:
        return split_rotation(self.config.width // self.config.heads, rows, columns, self.camera_token)
