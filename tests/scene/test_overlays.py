"""Overlays: what lies over photos is found and masked, and what belongs to the scene is not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene import overlays
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.masks import Overlay
from querysplat_cli.scene.overlays import find_static_part, without_overlays
from querysplat_cli.scene.photo_files import PhotoFile, large_views, read_photo_files, write_photo_files
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo, PhotoSource

HEIGHT, WIDTH = 240, 320
Draw = Callable[[np.ndarray], np.ndarray]


def textures(count: int, seed: int = 0) -> list[np.ndarray]:
    """Pictures that have nothing in common, with detail of all sizes from 2 to 64 pixels."""
    rng = np.random.default_rng(seed)
    pictures = []
    for _ in range(count):
        sums = np.zeros((HEIGHT, WIDTH, 3))
        for side in (2, 8, 32, 64):
            noise = rng.normal(size=(HEIGHT // side + 2, WIDTH // side + 2, 3)) * side**0.3
            sums += cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        pictures.append((128 + 40 * sums / sums.std()).clip(0, 255).astype(np.uint8))
    return pictures


def text(alpha: float) -> Draw:
    def draw(picture: np.ndarray) -> np.ndarray:
        over = picture.copy()
        cv2.putText(over, "12:30 Photo", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (255, 255, 255), 3, cv2.LINE_AA)
        return cv2.addWeighted(over, alpha, picture, 1 - alpha, 0)

    return draw


def bars(picture: np.ndarray) -> np.ndarray:
    return np.pad(picture[30:-30], ((30, 30), (0, 0), (0, 0)))


def frame(picture: np.ndarray) -> np.ndarray:
    return np.pad(picture[12:-12, 12:-12], ((12, 12), (12, 12), (0, 0)), constant_values=250)


def covered(draw: Draw) -> np.ndarray:
    """The pixels that `draw` changes in some picture."""
    return np.any([np.abs(draw(picture).astype(int) - picture).max(-1) > 12 for picture in textures(3)], axis=0)


@pytest.mark.parametrize(
    ("draw", "photos"), [(text(1.0), 7), (text(1.0), 16), (text(0.7), 12), (bars, 7), (bars, 12), (frame, 8)]
)
def test_overlays_are_covered(draw: Draw, photos: int) -> None:
    """Nearly all of it, and little beside it: at most eight pixels around."""
    pictures = [draw(picture) for picture in textures(photos)]
    part = find_static_part(pictures)
    assert part is not None
    hidden, over = ~part.overlay(pictures[-1]).shown(HEIGHT, WIDTH), covered(draw)
    assert hidden[over].mean() > 0.97
    around = cv2.dilate(over.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
    assert hidden[~around].mean() < 0.002


@pytest.mark.parametrize("photos", [5, 6, 8, 10, 16])
@pytest.mark.parametrize("seed", range(3))
def test_scenes_are_no_overlays(photos: int, seed: int) -> None:
    assert find_static_part(textures(photos, seed)) is None


def test_what_moves_little_is_no_overlay() -> None:
    """A far part of the scene that moves by one or two pixels from photo to photo, and the rest by more."""
    far = textures(1, 9)[0]
    share = np.clip(np.minimum(np.arange(HEIGHT) - 60, 160 - np.arange(HEIGHT)) / 30, 0, 1)[:, None, None]
    pictures = [
        (share * np.roll(far, (number % 3, number % 2), (0, 1)) + (1 - share) * picture).astype(np.uint8)
        for number, picture in enumerate(textures(12))
    ]
    assert find_static_part(pictures) is None


def test_photos_of_a_resting_camera_have_no_overlay() -> None:
    noise = np.random.default_rng(0)
    still = textures(1)[0].astype(int)
    pictures = [(still + noise.integers(-4, 5, still.shape)).clip(0, 255).astype(np.uint8) for _ in range(8)]
    assert find_static_part(pictures) is None


def test_what_turns_before_a_resting_camera_is_shown() -> None:
    """A turntable: its surroundings are covered in each picture, but not where the turning thing stands before them."""
    still = textures(1, 7)[0]
    pictures = []
    for number, picture in enumerate(textures(12)):
        thing = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.circle(thing, (160, 190), 90, 1, -1)
        cv2.rectangle(thing, (80 + 14 * number, 60), (120 + 14 * number, 110), 1, -1)
        pictures.append(np.where(thing[..., None] > 0, picture, still))
    part = find_static_part(pictures)
    assert part is not None
    for number in (0, 5, 11):
        hidden = ~part.overlay(pictures[number]).shown(HEIGHT, WIDTH)
        left = 80 + 14 * number
        assert hidden[65:105, left + 5 : left + 35].mean() < 0.3
        assert hidden[120:230, 100:220].mean() < 0.05
        assert hidden[:40].mean() > 0.95


def photo(pixels: np.ndarray, name: str, mask: np.ndarray | None = None) -> Photo:
    return Photo(name, Path(name), pixels, mask=mask)


def test_photos_of_each_size_are_looked_at_alone() -> None:
    """Four are too few. Masks of the user's stay, and the photos themselves are not changed."""
    marked = [text(1.0)(picture) for picture in textures(8)]
    own = np.ones((HEIGHT, WIDTH), bool)
    own[:, :10] = False
    photos = [photo(pixels, f"{number}.jpg", own if number == 3 else None) for number, pixels in enumerate(marked)]
    photos += [photo(text(1.0)(picture)[:, :300], f"small{n}.jpg") for n, picture in enumerate(textures(4, 5))]
    found, overlaid = without_overlays(photos)
    assert overlaid is not None
    assert overlaid.photos == 8
    overlay = found[0].overlay
    assert overlay is not None
    hidden = ~overlay.shown(HEIGHT, WIDTH)
    assert overlaid.share == pytest.approx(hidden.mean() * 8 / 12, rel=0.05)
    assert found[3].mask is not None
    assert found[3].overlay is not None
    np.testing.assert_array_equal(found[3].mask, found[3].overlay.shown(HEIGHT, WIDTH) & own)
    assert [each.mask is None for each in found[8:]] == [True] * 4
    assert found[0].source.overlay == overlay


def saved_again(picture: np.ndarray, quality: int) -> np.ndarray:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


@pytest.mark.parametrize("places", [4, 5])
def test_copies_of_photos_make_no_overlay(places: int) -> None:
    """A few photos, each there three times: edges of four of five places agree by chance. A logo is still found."""
    blurred = [cv2.GaussianBlur(picture, (0, 0), 1.5).astype(float) for picture in textures(places)]
    originals = [(128 + 3 * (picture - 128)).clip(0, 255).astype(np.uint8) for picture in blurred]
    copies = [copy for each in originals for copy in (each, saved_again(each, 70), each)]
    assert find_static_part(copies) is not None
    assert without_overlays([photo(each, f"{n}.jpg") for n, each in enumerate(copies)])[1] is None
    marked = without_overlays([photo(text(1.0)(each), f"{n}.jpg") for n, each in enumerate(copies)])[1]
    assert (marked is not None) == (places == 5)


def test_large_photos_are_masked_too(tmp_path: Path) -> None:
    """The overlay is found on small copies, kept in photos.json, and applies at the size of the file."""
    overlay = Overlay(((0.25, 0.125, 0.5, 0.25),))
    cv2.imwrite(str(tmp_path / "a.png"), textures(1)[0])
    lens = PhotoCamera(np.eye(4), (150.0, 150.0), (80.0, 60.0), (0.0, 0.0, 0.0, 0.0), HEIGHT // 2, WIDTH // 2)
    file = PhotoFile.of("a.png", PhotoSource(tmp_path / "a.png", overlay=overlay), lens)
    write_photo_files(tmp_path / "photos.json", [file])
    assert read_photo_files(tmp_path / "photos.json")["a.png"] == file
    small, cameras = undistorted([file.load(160)], [lens], max_size=160)
    large, _ = large_views([file], small, cameras, 320)
    for views, scale in ((small, 1), (large, 2)):
        rows, columns = views.sizes[0]
        hidden = ~views.masks[0, :rows, :columns]
        assert hidden[20 * scale : 40 * scale, 40 * scale : 80 * scale].all()
        assert int(hidden.sum()) == 800 * scale**2


def test_damaged_boxes_are_refused(tmp_path: Path) -> None:
    lens = PhotoCamera(np.eye(4), (150.0, 150.0), (80.0, 60.0), (0.0, 0.0, 0.0, 0.0), HEIGHT, WIDTH)
    for box in ((0.5, 0.1, 0.4, 0.2), (-0.5, 0.1, 0.4, 0.2), (0.0, 0.1, 1e9, 0.2)):
        file = PhotoFile.of("a.png", PhotoSource(Path("a.png"), overlay=Overlay((box,))), lens)
        write_photo_files(tmp_path / "photos.json", [file])
        with pytest.raises(QuerySplatError, match=r"photos\.json"):
            read_photo_files(tmp_path / "photos.json")


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.98), st.integers(20, 90), st.integers(20, 90))
def test_boxes_hold_whole_cells(seed: int, share: float, height: int, width: int) -> None:
    """The boxes are disjoint, and hold every cell that something covers, and no other."""
    cell = overlays.OVERLAY_POLICY.cell
    height, width = height - height % cell, width - width % cell
    cells = np.random.default_rng(seed).random((height // cell, width // cell)) < share
    expected = np.kron(cells, np.ones((cell, cell))) > 0
    boxes = overlays._boxes(expected)
    np.testing.assert_array_equal(~Overlay(boxes).shown(height, width), expected)
    assert sum((right - left) * (bottom - top) for left, top, right, bottom in boxes) * width**2 == pytest.approx(
        expected.sum(), abs=0.5 + 0.01 * expected.sum()
    )
