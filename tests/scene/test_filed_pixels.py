"""Pixels of many photos lie in a file."""

import mmap
import resource
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.filed_pixels import FiledPixels, release
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.views import Photo


def photo(seed: int, side: int = 64) -> Photo:
    pixels = np.random.default_rng(seed).integers(0, 255, (side, side + seed, 3), dtype=np.uint8)
    return Photo(f"{seed}.png", Path(f"{seed}.png"), pixels)


def test_photos_beyond_the_memory_are_the_same_photos(tmp_path: Path) -> None:
    """Of photos of several sizes, the first stays in memory; the others are read from the file, again and again."""
    photos = [photo(seed) for seed in range(5)]
    keep = FiledPixels(tmp_path, photos[0].pixels.nbytes)
    kept = [keep(each) for each in photos]
    assert kept[0] is photos[0]
    for before, after in zip(photos[1:], kept[1:], strict=True):
        assert isinstance(after.pixels.base, mmap.mmap)
        for _ in range(2):
            np.testing.assert_array_equal(after.pixels, before.pixels)
            release(after)
        assert (after.name, after.height, after.width) == (before.name, before.height, before.width)
    release(kept[0])
    np.testing.assert_array_equal(kept[0].pixels, photo(0).pixels)
    assert list(tmp_path.iterdir()) == []  # the file has no name


def test_masks_lie_in_the_file_too(tmp_path: Path) -> None:
    masked = [replace(photo(seed), mask=photo(seed).pixels[..., 0] > 99) for seed in range(2)]
    keep = FiledPixels(tmp_path, masked[0].pixels.nbytes)
    for before, after in zip(masked, map(keep, masked), strict=True):
        assert before.mask is not None
        assert after.mask is not None
        assert isinstance(after.mask.base, mmap.mmap)
        assert after.mask.dtype == bool
        for _ in range(2):
            np.testing.assert_array_equal(after.mask, before.mask)
            np.testing.assert_array_equal(after.pixels, before.pixels)
            release(after)


def test_files_are_read_into_it_one_by_one(tmp_path: Path) -> None:
    files = []
    for seed in range(3):
        files.append(tmp_path / f"{seed}.png")
        cv2.imwrite(str(files[-1]), photo(seed).pixels[..., ::-1])
    found, _ = load_photos(files, keep=FiledPixels(tmp_path, 0))
    for seed, each in enumerate(found):
        assert isinstance(each.pixels.base, mmap.mmap)
        np.testing.assert_array_equal(each.pixels, photo(seed).pixels)


@pytest.mark.skipif(not hasattr(mmap, "MADV_DONTNEED"), reason="this system cannot be asked to free a map")
def test_what_is_released_takes_no_memory(tmp_path: Path) -> None:
    keep, process = FiledPixels(tmp_path, 0), psutil.Process()
    kept = [keep(photo(seed, 2000)) for seed in range(8)]
    before = process.memory_info().rss
    for each in kept:
        assert each.pixels.any()
        release(each)
    assert process.memory_info().rss - before < 2 * kept[0].pixels.nbytes


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(QuerySplatError, match="no room for the pixels of all photos"):
            FiledPixels(tmp_path, 0)(photo(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
