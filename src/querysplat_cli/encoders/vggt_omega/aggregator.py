"""VGGT-Omega's aggregator: a DINOv3-style patch encoder, then alternating attention.

See docs/reference/official-checkpoint.md.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from querysplat_cli.encoders.transformer.aggregator import Aggregator
from querysplat_cli.encoders.transformer.blocks import Block, PatchConvolution
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.rotary import Rotation, axial_rotation
from querysplat_cli.runtime.precision import LayerNorm


class RotaryEmbedding(nn.Module):
    """The rotary embedding with the periods of the checkpoint."""

    def __init__(self, head_width: int) -> None:
        super().__init__()
        quarter = head_width // 4
        self.periods: Tensor
        self.register_buffer("periods", 100.0 ** (torch.arange(quarter) / quarter))

    def forward(self, rows: int, columns: int) -> Rotation:
        return axial_rotation(self.periods, rows, columns)


class PatchEncoder(nn.Module):
    """Patch tokens of each view alone. The class and storage tokens stay inside."""

    def __init__(self, config: VgmConfig) -> None:
        super().__init__()
        width = config.width
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.storage_tokens = nn.Parameter(torch.zeros(1, config.storage_tokens, width))
        # In the checkpoint, but unused.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = PatchConvolution(width, config.patch)
        self.rope_embed = RotaryEmbedding(width // config.heads)
        self.blocks = nn.ModuleList(
            Block(width, config.heads, normed=False, masked=True) for _ in range(config.vit_depth)
        )
        self.norm = LayerNorm(width)

    def first_tokens(
        self, images: Float[Tensor, "views 3 height width"]
    ) -> tuple[Float[Tensor, "views tokens channels"], Rotation]:
        """Class, storage and patch tokens as they enter the blocks, and the rotation of the patches."""
        patches = self.patch_embed.proj(images).to(self.cls_token.dtype)
        before = torch.cat([self.cls_token, self.storage_tokens], 1).expand(len(images), -1, -1)
        return torch.cat([before, patches.flatten(2).mT], 1), self.rope_embed(*patches.shape[-2:])

    def forward(self, images: Float[Tensor, "views 3 height width"]) -> Float[Tensor, "views patches channels"]:
        """Patch tokens of normalised images."""
        tokens, rotation = self.first_tokens(images)
        for block in self.blocks:
            tokens = block(tokens, rotation)
        return self.norm(tokens)[:, 1 + self.storage_tokens.shape[1] :]


class OmegaAggregator(Aggregator):
    """Patch positions enter only the attention inside views.

    In the blocks `config.register_blocks`, only camera and register tokens attend across views.
    """

    def __init__(self, config: VgmConfig) -> None:
        super().__init__(config, masked=True)
        self.rope_embed = RotaryEmbedding(config.width // config.heads)
        self.patch_embed = PatchEncoder(config)
        self.inter_frame_blocks = self.make_blocks(masked=True)

    def across_blocks(self) -> nn.ModuleList:
        return self.inter_frame_blocks

    def rotation(self, rows: int, columns: int) -> Rotation:
        return self.rope_embed(rows, columns)
