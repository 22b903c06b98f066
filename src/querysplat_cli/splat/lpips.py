"""LPIPS (Zhang et al. 2018, version 0.1). Its weights are the user's: none are bundled or downloaded.

Two files make it: a backbone as torchvision publishes it (vgg16-*.pth, alexnet-*.pth) and the linear layers as the
`lpips` package ships them (vgg.pth, alex.pth).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from pickle import UnpicklingError

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.runtime.caches import hub_checkpoints
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError

Perceptual = Callable[[Float[Tensor, "n 3 h w"], Float[Tensor, "n 3 h w"]], Float[Tensor, ""]]
"""LPIPS, or anything else that compares pictures in [0, 1]."""

MEAN, SPREAD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of the pictures' colours in [−1, 1], with which the backbones were trained."""


@dataclass(frozen=True)
class Backbone:
    """A torchvision network's convolutions: (index in `features`, in, out, kernel, stride, padding) or a pooling
    (kernel, stride), and the convolutions after whose ReLU features are taken."""

    pattern: str
    linear: str
    layers: tuple[tuple[int, ...], ...]
    taps: tuple[int, ...]


def _vgg() -> tuple[tuple[int, ...], ...]:
    layers: list[tuple[int, ...]] = []
    index, channels = 0, 3
    for block, (width, depth) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        if block:
            layers.append((2, 2))
            index += 1
        for _ in range(depth):
            layers.append((index, channels, width, 3, 1, 1))
            index, channels = index + 2, width  # a ReLU follows each
    return tuple(layers)


ALEX = (
    (0, 3, 64, 11, 4, 2), (3, 2), (3, 64, 192, 5, 1, 2), (3, 2),
    (6, 192, 384, 3, 1, 1), (8, 384, 256, 3, 1, 1), (10, 256, 256, 3, 1, 1),
)  # fmt: skip
BACKBONES = {
    "vgg": Backbone("vgg16-*.pth", "vgg.pth", _vgg(), (2, 7, 14, 21, 28)),
    "alex": Backbone("alexnet-*.pth", "alex.pth", ALEX, (0, 3, 6, 8, 10)),
}


class Lpips(nn.Module):
    """The distance of pictures, 0 for equal ones. `net` is "vgg" (as papers report it) or "alex".

    The backbones were trained on colours in [−1, 1]. `as_release` leaves those in [0, 1] as they are, which is what the
    release of QuerySplat optimises with.
    """

    def __init__(self, net: str, *, as_release: bool = False) -> None:
        super().__init__()
        self.as_release = as_release
        self.backbone = BACKBONES[net]
        convolutions = [layer for layer in self.backbone.layers if len(layer) == 6]
        self.features = nn.ModuleDict(
            {str(i): nn.Conv2d(a, b, size, stride, pad) for i, a, b, size, stride, pad in convolutions}
        )
        widths = [b for i, _, b, *_ in convolutions if i in self.backbone.taps]
        self.lin = nn.ModuleList(nn.Conv2d(width, 1, 1, bias=False) for width in widths)

    def forward(self, image: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, ""]:
        """The mean distance of n pairs, whose colours lie in [0, 1]."""
        total = image.new_zeros(())
        for linear, one, other in zip(self.lin, self._seen(image), self._seen(target), strict=True):
            total = total + linear((_unit(one) - _unit(other)).square()).mean()
        return total

    def _seen(self, image: Tensor) -> list[Tensor]:
        mean, spread = (image.new_tensor(values)[:, None, None] for values in (MEAN, SPREAD))
        x, seen = ((image if self.as_release else 2 * image - 1) - mean) / spread, []
        for layer in self.backbone.layers:
            if len(layer) == 2:
                x = F.max_pool2d(x, *layer)
                continue
            x = F.relu(self.features[str(layer[0])](x))
            if layer[0] in self.backbone.taps:
                seen.append(x)
        return seen


@dataclass(frozen=True)
class LpipsFiles:
    """Where the weights are."""

    net: str
    backbone: Path
    linear: Path


def find_lpips(folder: Path | None, net: str = "vgg") -> LpipsFiles | str:
    """The weights' files, or a sentence on why there are none.

    `folder` holds both; None looks in torch's hub cache and in an installed `lpips` package. Raises
    MissingPart when a folder is given and lacks one.
    """
    backbone = BACKBONES[net]
    places = [folder] if folder else [*hub_checkpoints(), *_package_folders()]
    trunk = _first(places, backbone.pattern)
    linear = _first(places, backbone.linear)
    if trunk and linear:
        return LpipsFiles(net, trunk, linear)
    lacking = " and ".join(
        part
        for part, found in (
            (f"the backbone {backbone.pattern}", trunk),
            (f"the linear layers {backbone.linear}", linear),
        )
        if not found
    )
    if folder:
        raise MissingPart(
            f"{folder}: LPIPS needs {lacking}",
            "The backbone is torchvision's file, the linear layers are in the lpips package (weights/v0.1).",
        )
    where = " or ".join([*map(str, hub_checkpoints()), "an installed lpips package"])
    return f"no LPIPS: {lacking} not found in {where}"


def load_lpips(files: LpipsFiles, *, as_release: bool = False) -> Lpips:
    """The network with its weights; raises QuerySplatError when a file is damaged or not the right one."""
    model = Lpips(files.net, as_release=as_release)
    trunk, linear = _tensors(files.backbone), _tensors(files.linear)
    wanted = model.state_dict()
    found = {name: trunk.get(name) for name in wanted if name.startswith("features.")}
    found |= {f"lin.{i}.weight": linear.get(f"lin{i}.model.1.weight") for i in range(len(model.lin))}
    for name, tensor in wanted.items():
        given = found[name]
        if given is None or given.shape != tensor.shape:
            file = files.linear if name.startswith("lin.") else files.backbone
            raise QuerySplatError(f"{file}: not the weights of LPIPS {files.net} ({name})", "Download the file again.")
    model.load_state_dict(found)
    return model.eval().requires_grad_(False)


def perceptual_loss(
    perceptual: Perceptual,
    picture: Float[Tensor, "views 3 height width"],
    photo: Float[Tensor, "views 3 height width"],
    mask: Bool[Tensor, "views height width"],
) -> Float[Tensor, ""]:
    """The distance of a picture from its photo in float32. Outside of the mask, the picture is the photo."""
    inside = torch.where(mask[:, None], picture.float(), photo)
    with torch.autocast(picture.device.type, enabled=False):
        return perceptual(inside, photo)


def _unit(features: Tensor) -> Tensor:
    squared = features.square().sum(1, keepdim=True)
    # The slope of a square root is infinite at 0, to which tiny features add up. The floor is lost beside 1e-10.
    return features / (squared.clamp_min(torch.finfo(squared.dtype).tiny).sqrt() + 1e-10)


def _package_folders() -> list[Path]:
    package = find_spec("lpips")
    return [Path(place) / "weights" / "v0.1" for place in (package and package.submodule_search_locations) or []]


def _first(places: Sequence[Path], pattern: str) -> Path | None:
    return next((file for place in places for file in sorted(place.glob(pattern))), None)


def _tensors(path: Path) -> dict[str, Tensor]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        return {name: tensor.float() for name, tensor in content.items()}
    except (OSError, RuntimeError, UnpicklingError, EOFError, AttributeError, ValueError) as error:
        raise QuerySplatError(f"{path}: no weights that can be read: {error}", "Download the file again.") from error
