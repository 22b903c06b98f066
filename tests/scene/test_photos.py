"""Any picture file becomes an upright 8-bit RGB photo, or is left out with the reason."""

from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.photo_names import short_names
from querysplat_cli.scene.photos import find_photos, load_photos, unread_folders
from querysplat_cli.scene.views import Photo

GENERATOR = np.random.default_rng(0)
SMOOTH = cv2.resize(GENERATOR.integers(0, 256, (6, 8, 3), dtype=np.uint8), (128, 96), interpolation=cv2.INTER_CUBIC)


def save(path: Path, pixels: np.ndarray = SMOOTH, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def load_one(path: Path, **options: int) -> Photo:
    photos, left_out = load_photos([path], **options)
    assert not left_out
    return photos[0]


def exif(tags: dict[int, object], orientation: int = 1) -> Image.Exif:
    data = Image.Exif()
    data[ExifTags.Base.Orientation] = orientation
    data.get_ifd(ExifTags.IFD.Exif).update(tags)
    return data


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for name in ("IMG_10.png", "img_9.png", "IMG_1.PNG", ".hidden.png"):
        save(tmp_path / name)
    assert [path.name for path in find_photos([tmp_path])] == ["IMG_1.PNG", "img_9.png", "IMG_10.png"]


def test_a_folder_of_jpegs_that_a_browser_named(tmp_path: Path) -> None:
    (save(tmp_path / "a.jpg")).rename(tmp_path / "a.jfif")
    assert find_photos([tmp_path]) == [tmp_path / "a.jfif"]


def test_folders_of_pictures_beside_the_photos_are_named(tmp_path: Path) -> None:
    for name in ("a.png", "day 2/b.png", "masks/a.png", "images_2/a.png", "scene/preview.png", ".thumbs/a.png"):
        save(tmp_path / name)
    (tmp_path / "scene" / "cameras.json").touch()
    (tmp_path / "notes").mkdir()
    assert [each.name for each in unread_folders([tmp_path])] == ["day 2"]
    assert not unread_folders([tmp_path, tmp_path / "day 2"])
    assert not unread_folders([tmp_path / "a.png"])
    (tmp_path / "day 2").chmod(0)
    unread_folders([tmp_path])  # lost+found of a card
    (tmp_path / "day 2").chmod(0o700)


def test_files_keep_the_order_given_and_come_once(tmp_path: Path) -> None:
    a, b = save(tmp_path / "a.png"), save(tmp_path / "b.png")
    assert find_photos([b, tmp_path, a]) == [b, a]


@pytest.mark.parametrize("scene", [".", "nerfstudio", "colmap"])
def test_the_largest_pictures_of_a_scene_folder_are_taken(tmp_path: Path, scene: str) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    for folder in ("images_8", "images_4"):
        save(tmp_path / scene / folder / "frame_00001.png")
    assert find_photos([tmp_path]) == [tmp_path / scene / "images_4" / "frame_00001.png"]


@pytest.mark.parametrize(
    ("make", "message", "hint"),
    [
        (lambda folder: folder / "missing", "no such file or folder", "folder of photos"),
        (lambda folder: folder, "empty folder", "Put the photos there"),
        (lambda folder: (folder / "notes.txt").write_text("x") and folder, "no pictures", "JPEG or PNG"),
        (lambda folder: (folder / "DSC_1.NEF").write_text("x") and folder, "no pictures", "DSC_1.NEF: raw photos"),
        (lambda folder: (folder / "album.zip").write_text("x") and folder, "no pictures", "album.zip: an archive"),
        (lambda folder: save(folder / "holiday" / "a.png") and folder, "no pictures", "holiday"),
        (lambda folder: all(save(folder / day / "a.png") for day in "12") and folder, "no pictures", "folders 1, 2"),
        (
            lambda folder: all(save(folder / f"images/cam{n}/a.png") for n in "01") and folder,
            "no pictures",
            "images/cam1",
        ),
    ],
    ids=[
        "missing",
        "empty",
        "no pictures",
        "raw photos",
        "an archive",
        "pictures further down",
        "in several folders",
        "by camera",
    ],
)
def test_inputs_without_pictures_are_refused(
    tmp_path: Path, make: Callable[[Path], Path], message: str, hint: str
) -> None:
    with pytest.raises(QuerySplatError, match=message) as caught:
        find_photos([make(tmp_path)])
    assert hint in caught.value.hint


def test_bad_files_among_good_ones_are_left_out_by_name(tmp_path: Path) -> None:
    save(tmp_path / "good_1.png")
    save(tmp_path / "good_2.jpg")
    save(tmp_path / "tiny.png", SMOOTH[:10, :10])
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("not a picture")
    ZipFile(tmp_path / "photos.zip", "w").close()
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    for name, whole in (("cut.jpg", "good_2.jpg"), ("cut.png", "good_1.png")):
        content = (tmp_path / whole).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2])
    photos, left_out = load_photos(find_photos([tmp_path]))
    assert [photo.name for photo in photos] == ["good_1.png", "good_2.jpg"]
    why = {each.name: each.why for each in left_out}
    assert why.keys() == {"tiny.png", "empty.jpg", "text.jpg", "photos.zip", "phone.heic", "cut.jpg", "cut.png"}
    assert why["empty.jpg"] == "the file is empty"
    assert "not a picture" in why["text.jpg"]
    assert "unpack" in why["photos.zip"]
    assert "10 × 10" in why["tiny.png"]
    assert "querysplat[heic]" in why["phone.heic"]
    assert "truncated" in why["cut.jpg"]


def test_only_bad_files_are_an_error_that_names_them(tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / f"bad_{number}.jpg").touch()
    with pytest.raises(QuerySplatError, match=r"none of the 5 .* bad_0\.jpg \(the file is empty\); .*bad_2.*; …"):
        load_photos(find_photos([tmp_path]))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_orientation_is_undone(tmp_path: Path, orientation: int, suffix: str) -> None:
    """Stored so that a viewer which applies the tag (TIFF 6.0, table 13) shows SMOOTH."""
    stored = {
        1: SMOOTH,
        2: SMOOTH[:, ::-1],
        3: SMOOTH[::-1, ::-1],
        4: SMOOTH[::-1],
        5: SMOOTH.transpose(1, 0, 2),
        6: np.rot90(SMOOTH, 1),
        7: SMOOTH.transpose(1, 0, 2)[::-1, ::-1],
        8: np.rot90(SMOOTH, -1),
    }[orientation]
    path = save(tmp_path / f"a{suffix}", np.ascontiguousarray(stored), exif=exif({}, orientation), quality=100)
    assert np.abs(load_one(path).pixels.astype(int) - SMOOTH).mean() < 2


def kinds() -> dict[str, tuple[str, Image.Image, np.ndarray]]:
    """Files of other kinds than RGB, and the RGB that they show."""
    grey = SMOOTH[..., 0]
    grey_rgb = np.repeat(grey[..., None], 3, 2)
    alpha = np.full((96, 128, 1), 255, np.uint8)
    alpha[:40] = 0
    over_white = np.where(alpha == 0, 255, SMOOTH).astype(np.uint8)
    palette = Image.fromarray(SMOOTH).quantize(64)
    return {
        "grey": (".png", Image.fromarray(grey), grey_rgb),
        "16-bit grey": (".png", Image.fromarray(grey.astype(np.uint16) * 257), grey_rgb),
        "16-bit grey tiff": (".tif", Image.fromarray(grey.astype(np.uint16) * 257), grey_rgb),
        "RGBA": (".png", Image.fromarray(np.concatenate([SMOOTH, alpha], 2)), over_white),
        "grey with alpha": (
            ".png",
            Image.fromarray(np.concatenate([grey[..., None], alpha], 2), "LA"),
            np.where(alpha == 0, 255, grey_rgb).astype(np.uint8),
        ),
        "palette": (".png", palette, np.array(palette.convert("RGB"))),
        "CMYK": (".tif", Image.fromarray(SMOOTH).convert("CMYK"), SMOOTH),
        "two-level": (".png", Image.fromarray(grey > 128), np.where(grey_rgb > 128, 255, 0).astype(np.uint8)),
    }


@pytest.mark.parametrize("kind", kinds())
def test_every_kind_becomes_rgb(tmp_path: Path, kind: str) -> None:
    suffix, image, shown = kinds()[kind]
    path = tmp_path / f"a{suffix}"
    image.save(path)
    pixels = load_one(path).pixels
    assert pixels.shape == (96, 128, 3)
    assert pixels.dtype == np.uint8
    assert np.abs(pixels.astype(int) - shown).max() <= 1


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_of_colour_keep_their_high_byte(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), SMOOTH[..., ::-1].astype(np.uint16) * 256 + 100)
    assert np.abs(load_one(path).pixels.astype(int) - SMOOTH).max() <= 1


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_large_photos_are_reduced_by_area(tmp_path: Path, suffix: str) -> None:
    blocks = np.kron(GENERATOR.integers(40, 216, (90, 120, 1)), np.ones((8, 8, 3))).astype(np.uint8)
    noise = GENERATOR.integers(-40, 40, blocks.shape)
    path = save(tmp_path / f"a{suffix}", (blocks + noise).clip(0, 255).astype(np.uint8), quality=98)
    pixels = load_one(path, max_side=120).pixels
    assert pixels.shape == (90, 120, 3)
    # The mean of 64 noisy pixels: standard deviation 23 / 8, and as much again for the JPEG.
    assert np.abs(pixels.astype(int) - blocks[::8, ::8]).mean() < 4


@pytest.mark.parametrize(("width", "height"), [(1600, 1200), (1601, 1201), (1605, 1203), (1606, 1207)])
def test_reduced_photos_end_where_the_photo_ends(tmp_path: Path, width: int, height: int) -> None:
    """A bump near the lower right corner is where it was, in shares of the sides."""
    bump = [np.exp(-0.5 * ((np.arange(side) + 0.5 - 0.9 * side) / 24) ** 2) for side in (height, width)]
    path = save(tmp_path / "a.jpg", (200 * np.outer(*bump))[..., None].repeat(3, 2).astype(np.uint8), quality=98)
    pixels = load_one(path, max_side=200).pixels[..., 0].astype(float)
    for axis, side in enumerate(pixels.shape):
        weight = pixels.sum(1 - axis) * (pixels.sum(1 - axis) > 0.1 * pixels.sum(1 - axis).max())
        assert weight @ (np.arange(side) + 0.5) / weight.sum() == pytest.approx(0.9 * side, abs=0.1)


@pytest.mark.parametrize(
    ("tags", "focal"),
    [
        ({ExifTags.Base.FocalLengthIn35mmFilm: 35}, 35 * 160 / 43.2666),
        # 10 mm at 100 pixels per centimetre of a 256-pixel sensor, of which the file keeps every other one.
        (
            {
                ExifTags.Base.FocalLength: 20.0,
                ExifTags.Base.FocalPlaneXResolution: 100.0,
                ExifTags.Base.FocalPlaneResolutionUnit: 3,
                ExifTags.Base.ExifImageWidth: 256,
            },
            20 * 10 / 2,
        ),
        # The density along the shorter side alone, in inches.
        (
            {
                ExifTags.Base.FocalLength: 12.7,
                ExifTags.Base.FocalPlaneYResolution: 200.0,
                ExifTags.Base.FocalPlaneResolutionUnit: 2,
                ExifTags.Base.ExifImageHeight: 96,
            },
            100.0,
        ),
        ({ExifTags.Base.FocalLengthIn35mmFilm: 0}, None),
        ({ExifTags.Base.FocalLengthIn35mmFilm: 60000}, None),
        ({ExifTags.Base.FocalLength: 20.0}, None),
        ({}, None),
    ],
    ids=["35 mm film", "sensor", "one side", "zero", "nonsense", "no sensor", "none"],
)
def test_focal_length_in_pixels(tmp_path: Path, tags: dict[int, object], focal: float | None) -> None:
    path = save(tmp_path / "a.jpg", exif=exif(tags, orientation=6))
    assert load_one(path).focal == pytest.approx(focal)
    assert load_one(path, max_side=96).focal == pytest.approx(focal and focal * 96 / 128)


def test_equal_names_in_two_folders_get_different_short_names(tmp_path: Path) -> None:
    for place in ("kitchen", "garden"):
        save(tmp_path / place / "1.png")
    save(tmp_path / "garden" / "2.png")
    photos, _ = load_photos(find_photos([tmp_path / "kitchen", tmp_path / "garden"]))
    assert [photo.name for photo in photos] == ["kitchen/1.png", "garden/1.png", "2.png"]


def test_short_names_are_as_short_as_they_can_be() -> None:
    paths = [Path("/x/a/images/1.png"), Path("/x/b/images/1.png"), Path("/x/b/images/2.png"), Path("/y/3.png")]
    assert short_names(paths) == ["a/images/1.png", "b/images/1.png", "2.png", "3.png"]


def test_no_short_name_leads_out_of_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    assert short_names([Path("/tmp/x/1.png"), Path("tmp/y/1.png")]) == ["x/1.png", "y/1.png"]
    assert short_names([Path("/tmp/1.png"), Path("/1.png")]) == ["tmp/1.png", "1.png"]
    monkeypatch.chdir("/tmp")
    assert short_names([Path("../1.png"), Path("1.png")]) == ["1.png", "tmp/1.png"]


def test_mixed_sizes_and_progress(tmp_path: Path) -> None:
    save(tmp_path / "1.png")
    save(tmp_path / "2.png", np.ascontiguousarray(SMOOTH.transpose(1, 0, 2)))
    told: list[tuple[str, float]] = []
    photos, _ = load_photos(find_photos([tmp_path]), progress=lambda text, fraction: told.append((text, fraction)))
    assert [(photo.height, photo.width) for photo in photos] == [(96, 128), (128, 96)]
    assert told == [("1.png", 0.5), ("2.png", 1.0)]


def test_real_photos(real_photos: Path) -> None:
    photos, left_out = load_photos(find_photos([real_photos / "dl3dv" / "fox"]))
    assert (len(photos), left_out) == (50, [])
    assert photos[0].pixels.shape == (480, 270, 3)
