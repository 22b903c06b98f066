""".spz and .sog: the error after writing and reading is that of their quantisation."""

import io
import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.formats.compressed import read_sog, read_spz, write_spz
from querysplat_cli.scene.gaussians import Gaussians


def cloud(count: int, degree: int, *, reach: float = 3.0) -> Gaussians:
    chance = torch.Generator().manual_seed(count + degree)
    sh = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=chance)
    return Gaussians(
        reach * (2 * torch.rand(count, 3, generator=chance) - 1),
        torch.randn(count, 4, generator=chance),
        torch.exp(-4 + torch.randn(count, 3, generator=chance)),
        0.05 + 0.9 * torch.rand(count, generator=chance),
        sh,
    )


def assert_close(found: Gaussians, original: Gaussians, *, position: float, colour: float, rest: float) -> None:
    """Within the steps of the format; rotations by their angle, as a quaternion and its negative are one."""
    assert len(found) == len(original)
    assert found.sh_degree == original.sh_degree
    assert float((found.means - original.means).abs().max()) <= position
    assert float((found.opacities - original.opacities).abs().max()) <= 0.6 / 255
    assert float((found.scales.log() - original.scales.log()).abs().max()) <= 0.07
    one, other = (torch.nn.functional.normalize(part.quats, dim=1) for part in (found, original))
    assert float((one * other).sum(1).abs().min()) > 0.99
    assert float((found.sh[:, 0] - original.sh[:, 0]).abs().max()) <= colour
    if original.sh_degree:
        assert float((found.sh[:, 1:] - original.sh[:, 1:]).abs().max()) <= rest


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("reach", [0.01, 3.0, 3000.0])
def test_spz_keeps_24_bits_of_position_whatever_the_size(tmp_path: Path, degree: int, reach: float) -> None:
    pytest.importorskip("gsply")
    scene = cloud(300, degree, reach=reach)
    assert write_spz(tmp_path / "a.spz", scene) == 300
    step = max(2.0**-20, 4 * reach * 2.0**-23)
    assert_close(read_spz(tmp_path / "a.spz"), scene, position=step, colour=0.6 / (0.15 * 255), rest=0.6 / 128)


def write_sog(path: Path, scene: Gaussians) -> None:
    """Version 2 by its specification: textures of one row, codebooks of 256 evenly spaced values, one palette entry
    for each Gaussian (at most 64)."""

    def texture(pixels: np.ndarray) -> bytes:
        stream = io.BytesIO()
        Image.fromarray(pixels.astype(np.uint8)[None], "RGBA").save(stream, "WEBP", lossless=True, exact=True)
        return stream.getvalue()

    def opaque(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.full((len(values), 1), 255)], 1)

    def coded(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
        book = np.linspace(values.min(), values.max(), 256)
        return np.abs(values[..., None] - book).argmin(-1), book.tolist()

    count = len(scene)
    means = scene.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    fixed = np.round((logs - low) / (high - low) * 65535).astype(int)
    quats = torch.nn.functional.normalize(scene.quats.double(), dim=1).numpy()
    largest = np.abs(quats).argmax(1)
    quats *= np.sign(quats[np.arange(count), largest])[:, None]
    rest = np.stack([np.delete(quat, place) for quat, place in zip(quats, largest, strict=True)])
    packed = np.concatenate([np.round((rest * 2**0.5 + 1) / 2 * 255), largest[:, None] + 252], 1)
    scales, scale_book = coded(scene.scales.double().log().numpy())
    colours, colour_book = coded(scene.sh[:, 0].double().numpy())
    alpha = np.round(scene.opacities.double().numpy() * 255)[:, None]
    bands, band_book = coded(scene.sh[:, 1:].double().numpy())
    palette = np.zeros((64, bands.shape[1], 4), int)
    palette[:count] = np.concatenate([bands, np.full((count, bands.shape[1], 1), 255)], 2)
    labels = np.stack([np.arange(count), np.zeros(count), np.zeros(count), np.full(count, 255)], 1)
    files = {
        "means_l.webp": opaque(fixed & 255),
        "means_u.webp": opaque(fixed >> 8),
        "quats.webp": packed,
        "scales.webp": opaque(scales),
        "sh0.webp": np.concatenate([colours, alpha], 1),
        "shN_centroids.webp": palette.reshape(-1, 4),
        "shN_labels.webp": labels,
    }
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "sh0": {"codebook": colour_book, "files": ["sh0.webp"]},
        "shN": {
            "count": count,
            "bands": scene.sh_degree,
            "codebook": band_book,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        },
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, pixels in files.items():
            archive.writestr(name, texture(pixels))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_sog_is_read(tmp_path: Path, degree: int) -> None:
    pytest.importorskip("gsply")
    pytest.importorskip("imagecodecs")
    scene = cloud(60, degree)
    write_sog(tmp_path / "a.sog", scene)
    assert_close(read_sog(tmp_path / "a.sog"), scene, position=2e-3, colour=0.005, rest=0.005)


def test_rows_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    pytest.importorskip("gsply")
    scene = cloud(5, 0)
    means = scene.means.clone()
    means[2, 1] = float("nan")
    broken = Gaussians(means, scene.quats, scene.scales, scene.opacities, scene.sh)
    assert write_spz(tmp_path / "a.spz", broken) == 4
    assert len(read_spz(tmp_path / "a.spz")) == 4


@pytest.mark.parametrize("suffix", ["spz", "sog"])
@pytest.mark.parametrize("content", [b"", b"no such file", b"\x1f\x8b\x08" + bytes(40)])
def test_damaged_files_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    pytest.importorskip("gsply")
    file = tmp_path / f"a.{suffix}"
    file.write_bytes(content)
    with pytest.raises(QuerySplatError, match="damaged"):
        (read_spz if suffix == "spz" else read_sog)(file)


def test_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsply", None)
    for action in (
        lambda: read_spz(tmp_path / "a.spz"),
        lambda: write_spz(tmp_path / "a.spz", cloud(3, 0)),
        lambda: read_sog(tmp_path / "a.sog"),
    ):
        with pytest.raises(MissingPart) as caught:
            action()
        assert "querysplat[formats]" in caught.value.hint
    assert list(tmp_path.iterdir()) == []
