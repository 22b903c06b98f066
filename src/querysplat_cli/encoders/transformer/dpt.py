"""The dense prediction transformer (DPT) that both depth heads share: layers of tokens to one map of each view.

Its parts have the names of the checkpoints; see docs/reference/official-checkpoint.md.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

POSITION_GAIN = 0.1
"""Weight of the positions that are added to the maps."""


class ResidualUnit(nn.Module):
    """Two 3 × 3 convolutions, each after a ReLU, added to the input; with `rectified`, to its positive part."""

    def __init__(self, channels: int, *, rectified: bool) -> None:
        super().__init__()
        self.rectified = rectified
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "n channels h w"]) -> Float[Tensor, "n channels h w"]:
        positive = F.relu(x)
        return self.conv2(F.relu(self.conv1(positive))) + (positive if self.rectified else x)


class Fusion(nn.Module):
    """Adds the next finer map to the coarser one (with `joins`), and resizes the sum."""

    def __init__(self, channels: int, *, joins: bool, rectified: bool) -> None:
        super().__init__()
        if joins:
            self.resConfUnit1 = ResidualUnit(channels, rectified=rectified)
        self.resConfUnit2 = ResidualUnit(channels, rectified=rectified)
        self.out_conv = nn.Conv2d(channels, channels, 1)

    def forward(
        self, x: Float[Tensor, "n channels h w"], finer: Tensor | None, size: tuple[int, int]
    ) -> Float[Tensor, "n channels height width"]:
        if finer is not None:
            x = x + self.resConfUnit1(finer)
        return self.out_conv(resize(self.resConfUnit2(x), size))


class Scratch(nn.Module):
    """Convolutions that bring every level to one width, and fusions from coarse to fine."""

    def __init__(self, levels: Sequence[int], channels: int, *, rectified: bool) -> None:
        super().__init__()
        for i, level in enumerate(levels, start=1):
            setattr(self, f"layer{i}_rn", nn.Conv2d(level, channels, 3, padding=1, bias=False))
            setattr(self, f"refinenet{i}", Fusion(channels, joins=i < len(levels), rectified=rectified))


class Pyramid(nn.Module):
    """Four layers of tokens to maps of 4, 2, 1 and 1/2 times the patch grid, which are fused to one map."""

    def __init__(self, inputs: int, levels: Sequence[int], scratch: Scratch) -> None:
        super().__init__()
        a, b, _, d = levels
        self.norm = nn.LayerNorm(inputs)
        self.projects = nn.ModuleList(nn.Conv2d(inputs, level, 1) for level in levels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(a, a, 4, 4),
                nn.ConvTranspose2d(b, b, 2, 2),
                nn.Identity(),
                nn.Conv2d(d, d, 3, 2, 1),
            ]
        )
        self.scratch = scratch

    def levels(
        self, layers: Sequence[Float[Tensor, "n patches inputs"]], grid: tuple[int, int], aspect: float
    ) -> list[Tensor]:
        """The four maps. `layers` are patch tokens, `grid` is (rows, columns), `aspect` is width / height."""
        maps = []
        for layer, narrow, scale in zip(layers, self.projects, self.resize_layers, strict=True):
            found = narrow(self.norm(layer.to(self.norm.weight.dtype)).mT.unflatten(2, grid))
            maps.append(scale(with_position(found, aspect)))
        return maps

    def fuse(self, levels: Sequence[Tensor], size: tuple[int, int]) -> list[Float[Tensor, "n channels h w"]]:
        """The maps after each fusion, coarsest first. The last one has the (height, width) `size`."""
        narrow = [getattr(self.scratch, f"layer{i}_rn")(level) for i, level in enumerate(levels, start=1)]
        x, fused = narrow[-1], []
        for i in range(len(levels), 0, -1):
            finer = narrow[i - 1] if i < len(levels) else None
            target = (narrow[i - 2].shape[-2], narrow[i - 2].shape[-1]) if i > 1 else size
            x = getattr(self.scratch, f"refinenet{i}")(x, finer, target)
            fused.append(x)
        return fused


def resize(x: Float[Tensor, "n channels h w"], size: tuple[int, int]) -> Float[Tensor, "n channels height width"]:
    """Resized bilinearly, with corner pixels on corner pixels."""
    return x if x.shape[-2:] == size else F.interpolate(x, size, mode="bilinear", align_corners=True)


def with_position(x: Float[Tensor, "n channels h w"], aspect: float) -> Float[Tensor, "n channels h w"]:
    """x + 0.1·P, where P are sines and cosines of the position in a picture whose half diagonal is 1."""
    _, channels, height, width = x.shape
    diagonal = (aspect**2 + 1) ** 0.5
    quarter = channels // 4
    frequencies = 100.0 ** (-torch.arange(quarter, dtype=torch.float64, device=x.device) / quarter)
    halves = []
    for count, reach in ((width, aspect / diagonal), (height, 1 / diagonal)):
        edge = reach * (count - 1) / count
        angles = frequencies[:, None] * torch.linspace(-edge, edge, count, dtype=torch.float64, device=x.device)
        halves.append(torch.cat([angles.sin(), angles.cos()]))
    across = halves[0][:, None].expand(-1, height, -1)
    down = halves[1][:, :, None].expand(-1, -1, width)
    return x + POSITION_GAIN * torch.cat([across, down]).to(x.dtype)
