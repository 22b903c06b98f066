"""LPIPS against an independent implementation, and against published figures where the weights are installed."""

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from lpips_weights import AFTER, WIDTHS, reference, write_weights
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.splat.lpips import BACKBONES, Lpips, LpipsFiles, find_lpips, load_lpips

PUBLISHED_VGG = 0.3493
"""torchmetrics 0.11's documentation: mean over ten pairs of uniform noise, 100 × 100, net_type 'vgg'."""


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


def test_as_in_the_release_colours_are_not_stretched(tmp_path: Path) -> None:
    """The release gives the network colours in [0, 1], where it expects [−1, 1]."""
    write_weights(tmp_path, "alex")
    files = find_lpips(tmp_path, "alex")
    assert isinstance(files, LpipsFiles)
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(1, 3, 64, 64, generator=generator) for _ in range(2))
    raw, usual = load_lpips(files, as_release=True), load_lpips(files)
    torch.testing.assert_close(raw(2 * a - 1, 2 * b - 1), usual(a, b))
    assert not torch.isclose(raw(a, b), usual(a, b))


def test_features_whose_squares_are_zero_have_a_gradient() -> None:
    """Features around 1e-25 made every gradient NaN; exact zeros did no harm, as their ReLU passes nothing on."""
    model = Lpips("alex").requires_grad_(False)
    for layer in model.features.values():
        assert isinstance(layer, torch.nn.Conv2d)
        layer.weight.abs_().mul_(1e-8)
        layer.bias = None
    generator = torch.Generator().manual_seed(0)
    one, other = (torch.rand(1, 3, 64, 64, generator=generator) for _ in range(2))
    last = model._seen(one)[-1]
    assert last.max() > 0
    assert last.square().max() == 0
    model(one.requires_grad_(), other).backward()
    assert one.grad is not None
    assert one.grad.isfinite().all()


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
