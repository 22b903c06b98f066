"""Sizes of a learned VGM."""

from dataclasses import dataclass

from querysplat_cli.runtime.tables import STRICT

VIEW_CHUNK = 16
"""Views that pass at once through the parts that work on single views."""


@dataclass(frozen=True)
class VgmConfig:
    """Sizes of a VGM; the defaults are those of VGGT-Omega 1B.

    `layers` are the blocks whose tokens become features, counted from 0. In `register_blocks` only the camera and
    register tokens attend to other views. `storage_tokens` is the number of tokens that stay inside the patch
    encoder. `pretrained_image` is the side, in pixels, of the pictures of the training.
    """

    __pydantic_config__ = STRICT

    width: int = 1024
    depth: int = 24
    vit_depth: int = 24
    heads: int = 16
    registers: int = 16
    storage_tokens: int = 4
    register_blocks: tuple[int, ...] = (2, 6, 9, 14, 20)
    layers: tuple[int, ...] = (4, 11, 17, 23)
    patch: int = 16
    pretrained_image: int = 512
    camera_heads: int = 16
    camera_blocks: int = 4
    depth_channels: int = 256
    depth_levels: tuple[int, ...] = (256, 512, 1024, 1024)

    @property
    def special_tokens(self) -> int:
        """The number of camera and register tokens, which come before the patches of a view."""
        return 1 + self.registers

    def working_bytes(self, views: int, size: int, half: bool, *, mixed: bool, depth: bool) -> int:
        """About the most memory in bytes of a pass over `views` pictures of `size` × `size` pixels, without weights.

        The largest terms are the tokens of all views, their queries, keys, values and attended values, the layers
        kept so far, one chunk of views inside an MLP, and the maps of the depth head. `half` says whether attention
        and MLP work in half precision, `mixed` whether only the mixture of the layers is kept.
        """
        tokens = self.special_tokens + (size // self.patch) ** 2
        whole = views * tokens * self.width * 4
        share = 0.5 if half else 1.0
        kept = 2 * (1 if mixed else len(self.layers)) + 2 * len(self.layers) * (depth and mixed)
        chunk = min(views, VIEW_CHUNK) * tokens * self.width * 4
        pyramid = 8 * size**2 * self.depth_channels * 4 if depth else 0
        return int(max(2 + 4 * share, 4) * whole + kept * whole + (3 + 8 * share) * chunk) + pyramid
