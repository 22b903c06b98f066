"""LPIPS by its definition, and files of random weights as torchvision and the lpips package write them."""

from pathlib import Path

import torch
from torch import Tensor, nn

VGG = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
WIDTHS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
AFTER = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
"""The layers of torchvision's `features` whose outputs count (the ReLUs)."""


def torchvision_features(net: str) -> nn.Sequential:
    """The convolutional part as torchvision lays it out, by its published configuration."""
    if net == "alex":
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(), nn.MaxPool2d(3, 2),
        )  # fmt: skip
    layers: list[nn.Module] = []
    channels = 3
    for width in VGG:
        if isinstance(width, str):
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return nn.Sequential(*layers)


def write_weights(folder: Path, net: str) -> tuple[nn.Sequential, list[Tensor]]:
    """Files with random weights as torchvision and the lpips package write them."""
    torch.manual_seed(3)
    features = torchvision_features(net)
    linear = [torch.rand(1, width, 1, 1) for width in WIDTHS[net]]
    trunk = {f"features.{name}": tensor for name, tensor in features.state_dict().items()}
    folder.mkdir(exist_ok=True)
    name = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}[net]
    torch.save({**trunk, "classifier.0.weight": torch.zeros(2, 2)}, folder / name)
    torch.save({f"lin{i}.model.1.weight": weight for i, weight in enumerate(linear)}, folder / f"{net}.pth")
    return features, linear


def reference(features: nn.Sequential, linear: list[Tensor], after: tuple[int, ...], a: Tensor, b: Tensor) -> float:
    """The definition, layer by layer, in float64."""
    mean = torch.tensor([-0.030, -0.088, -0.188]).double().view(1, 3, 1, 1)
    spread = torch.tensor([0.458, 0.448, 0.450]).double().view(1, 3, 1, 1)
    x, y = ((2 * picture.double() - 1 - mean) / spread for picture in (a, b))
    total, taken = 0.0, 0
    for number, layer in enumerate(features.double()):
        x, y = layer(x), layer(y)
        if number in after:
            one, other = (z / (z.norm(dim=1, keepdim=True) + 1e-10) for z in (x, y))
            total += float(((one - other) ** 2 * linear[taken].detach().double()).sum(1).mean().detach())
            taken += 1
    return total
