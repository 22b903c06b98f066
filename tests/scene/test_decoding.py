"""What is decoded, what is left out without being decoded, and what is printed meanwhile: nothing."""

import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import ExifTags, Image

from querysplat_cli.runtime import containers
from querysplat_cli.scene import decoding
from querysplat_cli.scene import photos as photos_module
from querysplat_cli.scene.photos import load_photo, load_photos
from querysplat_cli.scene.views import LeftOut, Photo

SMOOTH = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8).repeat(16, 0).repeat(16, 1)


def save(path: Path, pixels: np.ndarray = SMOOTH, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


def test_pictures_of_200_megapixels_and_damaged_exif_are_read_without_a_word(tmp_path: Path) -> None:
    Image.new("L", (16320, 12240)).save(tmp_path / "large.jpg", quality=30)
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    whole = save(tmp_path / "cut.jpg", exif=exif).read_bytes()
    place = whole.index(b"Exif\0\0") + 6
    (tmp_path / "cut.jpg").write_bytes(whole[: place + 8] + b"\xff\x00" + whole[place + 10 :])
    program = (
        "import sys, pathlib; from querysplat_cli.scene.photos import load_photos;"
        "print(*(photo.width for photo in load_photos(list(map(pathlib.Path, sys.argv[1:])))[0]))"
    )
    files = [str(tmp_path / name) for name in ("large.jpg", "cut.jpg")]
    done = subprocess.run([sys.executable, "-c", program, *files], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("1600 128\n", "")


def test_too_many_pixels_are_refused_before_they_are_decoded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(decoding, "MOST_PIXELS", 96 * 128 - 1)
    assert load_photo(save(tmp_path / "a.png"), "a.png", 1600) == LeftOut("a.png", "far too many pixels for a photo")


def test_a_panorama_strip_is_left_out_with_its_own_size(tmp_path: Path) -> None:
    path = save(tmp_path / "strip.png", np.zeros((400, 12000, 3), np.uint8))
    left_out = load_photo(path, "strip.png", 1600)
    assert left_out == LeftOut("strip.png", "12000 × 400 pixels are too long and narrow")


@pytest.mark.parametrize(("name", "subfile"), [("DSC_1.tif", 1), ("IMG_1.CR2", 0)])
def test_the_preview_of_a_raw_photo_is_no_photo(tmp_path: Path, name: str, subfile: int) -> None:
    raw = tmp_path / name
    Image.fromarray(SMOOTH).save(raw, "TIFF", tiffinfo={decoding.SUBFILE_TYPE: subfile})
    photos, left_out = load_photos([save(tmp_path / "DSC_1.jpg"), raw])
    assert [photo.name for photo in photos] == ["DSC_1.jpg"]
    assert "raw photos" in left_out[0].why


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".png"])
def test_an_animation_is_no_photo_and_a_picture_of_the_same_format_is_one(tmp_path: Path, suffix: str) -> None:
    more = [Image.fromarray(np.roll(SMOOTH, 16 * shift, 1)) for shift in (1, 2)]
    moving = save(tmp_path / f"moving{suffix}", save_all=True, append_images=more)
    photos, left_out = load_photos([moving, save(tmp_path / f"still{suffix}")])
    assert [photo.name for photo in photos] == [f"still{suffix}"]
    assert "an animation; save it as an MP4 film" in left_out[0].why


def test_what_cameras_keep_beside_a_film_is_no_photo(tmp_path: Path) -> None:
    save(tmp_path / "GX010001.jpg").rename(tmp_path / "GX010001.THM")
    photos, left_out = load_photos([save(tmp_path / "a.jpg"), tmp_path / "GX010001.THM", tmp_path / "00001.MTS"])
    assert [photo.name for photo in photos] == ["a.jpg"]
    assert "thumbnail" in left_out[0].why
    assert "save it as MP4" in left_out[1].why


@pytest.mark.parametrize("reads", [True, False])
def test_the_package_for_heic_is_named_only_where_it_is_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, reads: bool
) -> None:
    registered: list[bool] = []
    module = SimpleNamespace(register_heif_opener=lambda: registered.append(True))
    monkeypatch.setitem(sys.modules, "pillow_heif", module if reads else None)
    decoding._reads_heif.cache_clear()
    for name in ("a.jpg", "b.heic"):
        (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    whys = [load_photo(tmp_path / name, name, 1600).why for name in ("a.jpg", "b.heic")]
    decoding._reads_heif.cache_clear()
    assert registered == ([True] if reads else [])
    assert ["querysplat[heic]" in why for why in whys] == [not reads, not reads]


def test_few_photos_are_decoded_ahead_and_none_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[str] = []

    def decode(path: Path, name: str, max_side: int) -> Photo:
        decoded.append(name)
        return Photo(name, path, SMOOTH)

    def stop(photo: Photo) -> Photo:
        time.sleep(0.2)
        raise KeyboardInterrupt

    monkeypatch.setattr(photos_module, "load_photo", decode)
    monkeypatch.setattr(containers, "cores", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        load_photos([Path(f"{i}.png") for i in range(1000)], keep=stop)
    assert len(decoded) <= 2
