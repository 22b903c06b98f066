"""SOG version 2: read as its specification says, and written so that others read it."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_compressed import assert_close, cloud

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.palettes import codebook, nearest, palette
from querysplat_cli.scene.formats.sog import read_sog, write_sog
from querysplat_cli.scene.gaussians import Gaussians


def by_specification(path: Path, scene: Gaussians) -> None:
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
    scene = cloud(60, degree)
    by_specification(tmp_path / "a.sog", scene)
    assert_close(read_sog(tmp_path / "a.sog"), scene, position=2e-3, colour=0.005, rest=0.005)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_back(tmp_path: Path, degree: int) -> None:
    scene = cloud(700, degree)
    assert write_sog(tmp_path / "a.sog", scene) == 700
    found = read_sog(tmp_path / "a.sog")
    assert_close(found, scene, position=2e-3, colour=0.02, rest=0.9)
    if degree:
        lost = (found.sh[:, 1:] - scene.sh[:, 1:]).square().mean() / scene.sh[:, 1:].var()
        assert lost < 0.7  # of noise, which a palette of half as many entries suits worst


def test_centres_are_rounded_to_the_nearest_step_and_not_downwards(tmp_path: Path) -> None:
    scene = cloud(2000, 0)
    write_sog(tmp_path / "a.sog", scene)
    found = read_sog(tmp_path / "a.sog")
    before, after = (each.sign() * each.abs().log1p() for each in (scene.means.double(), found.means.double()))
    step = (before.max(0).values - before.min(0).values) / 65535
    errors = (after - before) / step
    assert errors.abs().max() < 0.55
    assert errors.mean(0).abs().max() < 0.05


def test_another_reader_sees_the_same(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    pytest.importorskip("imagecodecs")
    scene = cloud(300, 2)
    write_sog(tmp_path / "a.sog", scene)
    theirs, ours = gsply.sogread(tmp_path / "a.sog"), read_sog(tmp_path / "a.sog")
    np.testing.assert_allclose(theirs.means, ours.means.numpy(), atol=1e-4)
    np.testing.assert_allclose(np.exp(theirs.scales), ours.scales.numpy(), rtol=1e-3)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats.numpy()).sum(1)), 1, atol=1e-3)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0].numpy(), atol=1e-5)
    np.testing.assert_allclose(theirs.shN, ours.sh[:, 1:].numpy(), atol=1e-5)


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, cloud(200, 1))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_pictures_are_lossless_and_of_the_stated_sizes(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", cloud(700, 3))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        sizes = {}
        for name in archive.namelist():
            if name.endswith(".webp"):
                content = archive.read(name)
                assert b"VP8L" in content[:40]
                with Image.open(io.BytesIO(content)) as image:
                    sizes[name] = image.size
    assert meta["version"] == 2
    assert meta["shN"]["count"] == 512
    assert sizes.pop("shN_centroids.webp") == (64 * 15, 8)
    assert set(sizes.values()) == {(28, 28)}
    assert all(len(meta[part]["codebook"]) == 256 for part in ("scales", "sh0", "shN"))


@pytest.mark.parametrize("content", [b"", b"no such file", b"\x1f\x8b\x08" + bytes(40)])
def test_damaged_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.sog").write_bytes(content)
    with pytest.raises(QuerySplatError, match="damaged"):
        read_sog(tmp_path / "a.sog")


def test_a_file_that_lacks_a_part_or_has_another_version(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", cloud(20, 0))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    for change, message in (({"version": 1}, "version 1"), ({"count": 10**6}, "damaged"), ({"sh0": {}}, "damaged")):
        with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
            meta = json.loads(files["meta.json"]) | change
            for name, part in (files | {"meta.json": json.dumps(meta).encode()}).items():
                archive.writestr(name, part)
        with pytest.raises(QuerySplatError, match=message):
            read_sog(tmp_path / "b.sog")


def test_codebooks_fit_their_values() -> None:
    values = np.concatenate([np.random.default_rng(0).normal(size=5000), [30.0, -20.0]])
    book = codebook(values)
    assert len(book) <= 256
    error = np.abs(book[nearest(values, book)] - values)
    assert error[:5000].max() < 0.2
    assert error.mean() < 0.01
    few = np.array([3.0, 1.0, 3.0])
    np.testing.assert_array_equal(codebook(few), [1, 3])


def test_palettes_find_clusters() -> None:
    chance = np.random.default_rng(0)
    middles = chance.normal(size=(16, 9))
    rows = middles[chance.integers(0, 16, 2000)] + 0.01 * chance.normal(size=(2000, 9))
    centres, labels = palette(rows, 64)
    assert len(centres) <= 64
    assert np.abs(centres[labels] - rows).max() < 0.1
    same, numbers = palette(np.ones((5, 3)), 8)
    np.testing.assert_array_equal(same[numbers], np.ones((5, 3)))
