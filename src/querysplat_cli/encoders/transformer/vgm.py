"""A learned VGM: aggregator, camera head and depth head, and how they are loaded."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from querysplat_cli.encoders.transformer.aggregator import Aggregator
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.pose import decode_pose
from querysplat_cli.runtime.checkpoint_files import check_tensors, fill, read_tensors
from querysplat_cli.runtime.choices import Precision
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import weight_dtypes
from querysplat_cli.runtime.tables import from_tables
from querysplat_cli.scene.cameras import Cameras

DEPTH_CHUNK = 8
"""Views that pass through the depth head at once."""


@dataclass(frozen=True)
class VgmOutput:
    """The result of one pass.

    `features` are the cached layers, or only their mixture. `depth` is camera z, `confidence` is in [0, 1); both are
    None where no depth was asked for.
    """

    cameras: Cameras
    features: tuple[Float[Tensor, "views tokens channels"], ...]
    depth: Float[Tensor, "views height width"] | None
    confidence: Float[Tensor, "views height width"] | None


class Vgm(nn.Module):
    """Photos to cameras, features and depth. Its parts have the names of the checkpoint.

    A subclass adds its heads. `config` gives the sizes of all parts.
    """

    aggregator: Aggregator

    def __init__(self, config: VgmConfig, aggregator: Aggregator) -> None:
        super().__init__()
        self.config = config
        self.aggregator = aggregator

    def pose(self, last: Float[Tensor, "views specials channels"]) -> Float[Tensor, "views 9"]:
        """Pose encodings (see `pose.py`) from the camera and register tokens of the last layer."""
        raise NotImplementedError

    def depth(
        self, layers: Sequence[Float[Tensor, "views patches channels"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "views height width"], Float[Tensor, "views height width"]]:
        """Depth and confidence (≥ 1) from the patch tokens of the layers."""
        raise NotImplementedError

    @torch.no_grad()
    def predict(
        self,
        images: Float[Tensor, "views 3 height width"],
        *,
        mixture: Sequence[float] | None = None,
        depth: bool = True,
        progress: Callable[[float], None] = lambda fraction: None,
    ) -> VgmOutput:
        """One pass over images in [0, 1].

        With a `mixture` (a weight for each layer), the features are the weighted sum of the layers' patch tokens, with
        the camera and register tokens of the last layer. It is summed layer by layer, which saves memory.
        """
        height, width = images.shape[-2:]
        start, patch = self.config.special_tokens, self.config.patch
        kept: list[Tensor] = []
        mixed, patches = None, []
        count = len(self.config.layers)
        for i, layer in enumerate(self.aggregator.layers(images)):
            if mixture is None:
                kept.append(layer)
            elif mixed is None:
                mixed = layer.mul(mixture[i])
            else:
                mixed.add_(layer, alpha=mixture[i])
            if depth:
                patches.append(layer[:, start:])
            special = layer[:, :start].clone()
            progress((i + 1) / count)
            del layer
        if mixed is not None:
            mixed[:, :start] = special
            kept = [mixed]
        cameras = decode_pose(self.pose(special), height, width)
        maps = self._depth(patches, (height // patch, width // patch)) if depth else (None, None)
        return VgmOutput(cameras, tuple(kept), *maps)

    def _depth(self, patches: Sequence[Tensor], grid: tuple[int, int]) -> tuple[Tensor, Tensor]:
        chunks = zip(*(layer.split(DEPTH_CHUNK) for layer in patches), strict=True)
        depth, confidence = zip(*(self.depth(chunk, grid) for chunk in chunks), strict=True)
        return torch.cat(depth), 1 - 1 / torch.cat(confidence)


def load_vgm(
    make: Callable[[VgmConfig], Vgm],
    default: VgmConfig,
    path: Path,
    *,
    precision: Precision = "fp32",
    device: torch.device = torch.device("cpu"),  # noqa: B008 - immutable
) -> Vgm:
    """A frozen VGM from its checkpoint: the aggregator at `precision`, the heads in float32.

    The metadata of a .safetensors file may replace the configuration `default`. Tensors of other models in the same
    file are ignored. Raises QuerySplatError when the file is damaged or its tensors do not fit.
    """
    tensors, metadata = read_tensors(path)
    config = default
    if "config" in metadata:
        try:
            config = from_tables(VgmConfig, json.loads(metadata["config"]), what="VGM", docs="docs/method.md")
        except (ValueError, TypeError, RecursionError) as error:
            raise QuerySplatError(f"{path}: its configuration cannot be read: {error}", "Make it again.") from error
    with torch.device("meta"):
        model = make(config)
    parts = tuple(f"{name}." for name, _ in model.named_children())
    found = {name: tensor for name, tensor in tensors.items() if name.startswith(parts)}
    check_tensors(model, found, str(path))
    dtypes = {
        name: dtype if name.startswith("aggregator.") else torch.float32
        for name, dtype in weight_dtypes(model, precision).items()
    }
    fill(model, path, {name: name for name in found}, dtypes, device)
    return model.requires_grad_(False).eval()
