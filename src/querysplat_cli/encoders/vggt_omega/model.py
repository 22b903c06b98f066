"""VGGT-Omega 1B at 512 pixels (Meta; `facebook/VGGT-Omega`)."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.vgm import Vgm
from querysplat_cli.encoders.vggt_omega.aggregator import OmegaAggregator
from querysplat_cli.encoders.vggt_omega.heads import CameraHead, DepthHead

VGGT_OMEGA_CONFIG = VgmConfig()


class VggtOmega(Vgm):
    """VGGT-Omega. Its checkpoint holds 1,411 tensors under the prefixes of the three parts."""

    def __init__(self, config: VgmConfig) -> None:
        super().__init__(config, OmegaAggregator(config))
        inputs = 2 * config.width
        self.camera_head = CameraHead(inputs, config.camera_heads, config.camera_blocks)
        self.dense_head = DepthHead(inputs, config.depth_channels, config.depth_levels)

    def pose(self, last: Float[Tensor, "views specials channels"]) -> Float[Tensor, "views 9"]:
        return self.camera_head(last)

    def depth(
        self, layers: Sequence[Float[Tensor, "views patches channels"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "views height width"], Float[Tensor, "views height width"]]:
        return self.dense_head(layers, grid)
