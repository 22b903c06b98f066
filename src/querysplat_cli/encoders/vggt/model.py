"""VGGT 1B at 518 pixels (Meta and Oxford; `facebook/VGGT-1B`), the backbone of the paper's ablation."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.vgm import Vgm
from querysplat_cli.encoders.vggt.aggregator import VggtAggregator
from querysplat_cli.encoders.vggt.heads import CameraHead, DepthHead

VGGT_CONFIG = VgmConfig(registers=4, register_blocks=(), patch=14, pretrained_image=518)


class Vggt(Vgm):
    """VGGT without its point and track heads, which are not used."""

    def __init__(self, config: VgmConfig) -> None:
        super().__init__(config, VggtAggregator(config))
        inputs = 2 * config.width
        self.camera_head = CameraHead(inputs, config.camera_heads, config.camera_blocks)
        self.depth_head = DepthHead(inputs, config.patch, config.depth_channels, config.depth_levels)

    def pose(self, last: Float[Tensor, "views specials channels"]) -> Float[Tensor, "views 9"]:
        return self.camera_head(last[:, 0])[-1]

    def depth(
        self, layers: Sequence[Float[Tensor, "views patches channels"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "views height width"], Float[Tensor, "views height width"]]:
        return self.depth_head(layers, grid)
