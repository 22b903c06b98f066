"""LPIPS against an independent implementation, and against published figures where the weights are installed."""

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from querysplat_cli.evaluation.lpips import BACKBONES, Lpips, LpipsFiles, find_lpips, load_lpips
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError

VGG = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
WIDTHS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
AFTER = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
"""The layers of torchvision's `features` whose outputs count (the ReLUs)."""
PUBLISHED_VGG = 0.3493
"""torchmetrics 0.11's documentation: mean over ten pairs of uniform noise, 100 × 100, net_type 'vgg'."""


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
            total += float(((one - other) ** 2 * linear[taken].double()).sum(1).mean())
            taken += 1
    return total


@pytest.mark.parametrize("net", sorted(BACKBONES))
def test_the_network_is_the_defined_one(tmp_path: Path, net: str) -> None:
    features, linear = write_weights(tmp_path, net)
    found = find_lpips(tmp_path, net)
    assert isinstance(found, LpipsFiles)
    model = load_lpips(found)
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 3, 70, 90, generator=generator), torch.rand(2, 3, 70, 90, generator=generator)
    with torch.no_grad():
        assert float(model(a, b)) == pytest.approx(reference(features, linear, AFTER[net], a, b), rel=1e-4)
        assert float(model(a, a)) == 0.0
        assert float(model(a, b)) == pytest.approx(float(model(b, a)), rel=1e-6)


def test_it_works_where_the_pictures_are() -> None:
    """No tensor is left on the CPU: like CUDA, the meta device refuses to mix them."""
    pictures = torch.zeros(1, 3, 64, 64, device="meta")
    assert Lpips("alex").to("meta")(pictures, pictures).device.type == "meta"


def test_missing_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    sentence = find_lpips(None, "vgg")
    assert isinstance(sentence, str)
    assert "vgg16" in sentence
    assert str(tmp_path) in sentence
    with pytest.raises(MissingPart, match=r"backbone alexnet-\*\.pth and the linear layers alex\.pth"):
        find_lpips(tmp_path, "alex")
    write_weights(tmp_path / "hub", "alex")
    (tmp_path / "hub").rename(tmp_path / "checkpoints")
    (tmp_path / "hub").mkdir()
    (tmp_path / "checkpoints").rename(tmp_path / "hub" / "checkpoints")
    assert isinstance(find_lpips(None, "alex"), LpipsFiles)


@pytest.mark.parametrize("net", sorted(BACKBONES))
def test_the_lpips_package_brings_the_linear_layers_and_no_backbone(
    net: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = find_spec("lpips")
    if package is None or package.origin is None:
        pytest.skip("the lpips package is not installed")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    sentence = find_lpips(None, net)
    assert isinstance(sentence, str)
    assert "backbone" in sentence
    assert "linear layers" not in sentence
    content = torch.load(
        Path(package.origin).parent / "weights" / "v0.1" / f"{net}.pth", map_location="cpu", weights_only=True
    )
    shapes = {f"lin{i}.model.1.weight": (1, width, 1, 1) for i, width in enumerate(WIDTHS[net])}
    assert {name: tuple(tensor.shape) for name, tensor in content.items()} == shapes
    with torch.no_grad():
        assert all(float(tensor.min()) >= 0 for tensor in content.values())


def test_wrong_and_damaged_files_are_refused(tmp_path: Path) -> None:
    write_weights(tmp_path, "alex")
    files = find_lpips(tmp_path, "alex")
    assert isinstance(files, LpipsFiles)
    swapped = LpipsFiles("alex", files.linear, files.backbone)
    with pytest.raises(QuerySplatError, match="not the weights of LPIPS alex"):
        load_lpips(swapped)
    files.linear.write_bytes(b"no weights")
    with pytest.raises(QuerySplatError, match=r"alex\.pth"):
        load_lpips(files)


def test_a_published_figure() -> None:
    files = find_lpips(None, "vgg")
    if isinstance(files, str):
        pytest.skip(files)
    model: Lpips = load_lpips(files)
    generator = torch.Generator().manual_seed(123)
    a, b = (torch.rand(10, 3, 100, 100, generator=generator) for _ in range(2))
    # Their draw of the noise cannot be repeated (building the network takes from the same stream), its mean can.
    assert float(model(a, b)) == pytest.approx(PUBLISHED_VGG, abs=0.005)
