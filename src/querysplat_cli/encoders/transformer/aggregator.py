"""Alternating attention inside views and between views: the part that VGGT and VGGT-Omega share."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn

from querysplat_cli.encoders.transformer.blocks import Block
from querysplat_cli.encoders.transformer.config import VIEW_CHUNK, VgmConfig
from querysplat_cli.encoders.transformer.rotary import Rotation
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.fit import normalised


class Aggregator(nn.Module):
    """Photos to tokens. A subclass provides `patch_embed`, the blocks between views, and the rotary embedding.

    With `rotate_across`, patch positions also enter the attention between views.
    """

    rotate_across = False
    patch_embed: nn.Module

    def __init__(self, config: VgmConfig, *, masked: bool) -> None:
        super().__init__()
        self.config = config
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, config.width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, config.registers, config.width))
        self.frame_blocks = self.make_blocks(masked=masked)

    def make_blocks(self, *, masked: bool) -> nn.ModuleList:
        config = self.config
        return nn.ModuleList(Block(config.width, config.heads, normed=True, masked=masked) for _ in range(config.depth))

    def across_blocks(self) -> nn.ModuleList:
        """The blocks with attention between views."""
        raise NotImplementedError

    def rotation(self, rows: int, columns: int) -> Rotation:
        """The rotary embedding of a grid of patches."""
        raise NotImplementedError

    def first_tokens(
        self, images: Float[Tensor, "views 3 height width"], chunk: int
    ) -> Float[Tensor, "views tokens channels"]:
        """Camera token, registers and patches, as they enter the blocks.

        The first view has camera and register tokens of its own; all other views share one set.
        """
        start = self.config.special_tokens
        count = images.shape[-2] // self.config.patch * (images.shape[-1] // self.config.patch)
        tokens = torch.empty(
            len(images), start + count, self.config.width, dtype=self.camera_token.dtype, device=images.device
        )
        special = torch.cat([self.camera_token, self.register_token], 2)[0]
        tokens[:1, :start], tokens[1:, :start] = special[0], special[1]
        for part, photos in zip(tokens.split(chunk), images.split(chunk), strict=True):
            part[:, start:] = self.patch_embed(normalised(photos))
        return tokens

    @torch.no_grad()
    def layers(
        self, images: Float[Tensor, "views 3 height width"], chunk: int = VIEW_CHUNK
    ) -> Iterator[Float[Tensor, "views tokens channels"]]:
        """The tokens of each layer in `config.layers`.

        A layer joins, along the channels, the tokens after its attention inside views and those after its attention
        between views. `images` are in [0, 1]; their sides are multiples of the patch, and QuerySplatError is raised
        otherwise. Work on single views is done `chunk` views at a time, which changes only time and memory.
        """
        start, patch = self.config.special_tokens, self.config.patch
        if images.shape[-2] % patch or images.shape[-1] % patch:
            raise QuerySplatError(
                f"pictures of {images.shape[-1]} × {images.shape[-2]} pixels do not divide into patches of {patch}",
                "Give sides that are multiples of the patch.",
            )
        tokens = self.first_tokens(images, chunk)
        rotation = self.rotation(images.shape[-2] // patch, images.shape[-1] // patch)
        for i, (frame, across) in enumerate(zip(self.frame_blocks, self.across_blocks(), strict=True)):
            assert isinstance(frame, Block)
            assert isinstance(across, Block)
            frame.within_(tokens, rotation, chunk)
            alone = tokens.clone() if i in self.config.layers else None
            if i in self.config.register_blocks:
                special = tokens[:, :start].flatten(0, 1)[None]
                tokens[:, :start] = across(special)[0].unflatten(0, (len(tokens), start))
            else:
                across.across_(tokens, rotation if self.rotate_across else None, chunk)
            if alone is not None:
                yield torch.cat([alone, tokens], -1)
