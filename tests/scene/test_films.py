"""Films are decoded upright, in true colours, and their frames are found again by pts."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from film_files import pan, write_film
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene import films
from querysplat_cli.scene.colour_profiles import D65
from querysplat_cli.scene.film_colours import BT709, HLG, PQ, WHITE_CODE, rgb_of, tone_mapped
from querysplat_cli.scene.films import FilmFrame, evenly_spaced_frames, film_frames, film_size, frame_pixels, read_ahead

BT2020, DISPLAY_P3 = 9, 12


def plain(colour: tuple[int, int, int], count: int = 3) -> list[np.ndarray]:
    return [np.full((96, 160, 3), colour, np.uint8) for _ in range(count)]


def flagged() -> np.ndarray:
    """Grey, with a white corner at the top left."""
    picture = np.full((96, 160, 3), 60, np.uint8)
    picture[:48, :80] = 255
    return picture


@pytest.mark.parametrize(
    ("rotation", "shape", "corner"),
    [(0, (96, 160), (0, 0)), (90, (160, 96), (1, 0)), (180, (96, 160), (1, 1)), (-90, (160, 96), (0, 1))],
)
def test_frames_are_upright(tmp_path: Path, rotation: int, shape: tuple[int, int], corner: tuple[int, int]) -> None:
    path = write_film(tmp_path / "turned.mp4", [flagged()] * 2, rotation=rotation)
    pixels = next(film_frames(path)).rgb()
    assert pixels.shape[:2] == film_size(path) == shape
    quarters = pixels.reshape(2, shape[0] // 2, 2, shape[1] // 2, 3).mean((1, 3, 4))
    assert np.unravel_index(quarters.argmax(), (2, 2)) == corner


@pytest.mark.parametrize(("suffix", "codec"), [("mov", "libx264"), ("webm", "libvpx-vp9"), ("avi", "mpeg4")])
def test_containers(tmp_path: Path, suffix: str, codec: str) -> None:
    path = write_film(tmp_path / f"film.{suffix}", pan([0, 20, 40]), codec=codec)
    frames = list(film_frames(path))
    assert len(frames) == 3
    for frame in frames:
        difference = frame_pixels(path, frame.pts).astype(int) - frame.rgb()
        assert np.abs(difference).mean() < 2


def test_time_stamps_are_those_of_the_film_not_of_a_rate(tmp_path: Path) -> None:
    times = [0, 40, 900, 1000, 2500]
    path = write_film(tmp_path / "phone.mp4", pan([0, 5, 10, 15, 20]), milliseconds=times)
    assert [round(1000 * frame.seconds) for frame in film_frames(path)] == times


def test_a_frame_is_found_again_by_its_pts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    levels = [10 * i for i in range(20)]
    path = write_film(tmp_path / "grey.mp4", [np.full((96, 160, 3), level, np.uint8) for level in levels])
    stamps = [frame.pts for frame in film_frames(path)]
    for number in (13, 2, 19):
        assert abs(float(frame_pixels(path, stamps[number]).mean()) - levels[number]) < 3
    with pytest.raises(QuerySplatError, match="no frame at pts"):
        frame_pixels(path, stamps[3] + 1)
    monkeypatch.setattr(films, "_PACKED", films._PackedFrames(most_bytes=1))
    for number in (5, 4):
        assert abs(float(frame_pixels(path, stamps[number]).mean()) - levels[number]) < 3


def test_a_replaced_film_is_decoded_anew(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", plain((200, 200, 200)))
    assert frame_pixels(path, 0).mean() > 190
    write_film(path, plain((20, 20, 20)))
    os.utime(path, ns=(1, 1))
    assert frame_pixels(path, 0).mean() < 30


def test_ten_bits_of_standard_range_keep_their_colour(tmp_path: Path) -> None:
    eight = next(film_frames(write_film(tmp_path / "8.mp4", plain((200, 30, 60))))).rgb()
    deep = write_film(tmp_path / "10.mp4", plain((200, 30, 60)), codec="libx265", pixels="yuv420p10le")
    assert np.abs(next(film_frames(deep)).rgb().astype(int) - eight).max() <= 4


def plain_frame(luma: int, blue: int, red: int, bits: int) -> av.VideoFrame:
    """A frame in YCbCr of BT.709 and limited range, whose numbers have so many bits."""
    frame = av.VideoFrame(64, 48, "yuv420p" if bits == 8 else "yuv420p10le")
    for plane, value in zip(frame.planes, (luma, blue, red), strict=True):
        kind = np.uint8 if bits == 8 else np.uint16
        plane.update(np.full(plane.buffer_size // kind().itemsize, value, kind).tobytes())
    frame.colorspace, frame.color_range = BT709, 1
    return frame


@pytest.mark.parametrize("bits", [8, 10])
def test_colours_are_not_too_dark(bits: int) -> None:
    """The standard's colour, but for rounding."""
    unit = 1 << (bits - 8)
    errors = []
    for y, u, v in np.random.default_rng(0).integers((40, 118, 118), (220, 139, 139), (200, 3)) * unit:
        luma, blue, red = (y / unit - 16) / 219, (u / unit - 128) / 224, (v / unit - 128) / 224
        r, b = luma + 1.5748 * red, luma + 1.8556 * blue
        true = 255 * np.array([r, (luma - 0.2126 * r - 0.0722 * b) / 0.7152, b])
        error = rgb_of(plain_frame(y, u, v, bits), BT709).mean((0, 1)) - true
        errors.append(error[(true >= 0) & (true <= 255)].mean())
    assert abs(np.mean(errors)) < 0.1


def light_to_xyz(*corners: tuple[float, float]) -> np.ndarray:
    """The matrix of primaries in CIE x and y whose white is D65."""
    shares = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*corners, D65)])
    return (np.linalg.solve(shares[:3].T, shares[3])[:, None] * shares[:3]).T


@pytest.mark.parametrize(
    ("number", "primaries"),
    [
        (BT2020, ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046))),
        (DISPLAY_P3, ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06))),
    ],
)
def test_wide_primaries_without_hdr_become_those_of_srgb(
    tmp_path: Path, number: int, primaries: tuple[tuple[float, float], ...]
) -> None:
    """As those of photos do. They were taken for those of sRGB, and looked pale."""
    matrix = np.linalg.inv(light_to_xyz((0.64, 0.33), (0.3, 0.6), (0.15, 0.06))) @ light_to_xyz(*primaries)
    for colour, change in (((170, 110, 90), 8), ((90, 140, 80), 8), ((90, 110, 180), 4), ((128, 128, 128), 0)):
        plainly = next(film_frames(write_film(tmp_path / "a.mp4", plain(colour)))).rgb()[0, 0].astype(int)
        wide = write_film(tmp_path / "b.mp4", plain(colour), tags={"color_primaries": number})
        found = next(film_frames(wide)).rgb()[0, 0].astype(int)
        light = matrix @ ((plainly / 255 + 0.055) / 1.055) ** 2.4
        assert np.abs(found - 255 * (1.055 * light.clip(0, 1) ** (1 / 2.4) - 0.055)).max() <= 1
        moved = np.abs(found - plainly).max()
        assert moved >= change if change else moved <= 1


def test_hdr_is_not_too_dark() -> None:
    """Greys up to 140 nits, by SMPTE ST 2084 and the curve of sRGB."""
    errors = []
    for luma in range(300, 530):
        power = ((luma - 64) / 876) ** (1 / 78.84375)
        nits = 1e4 * ((power - 0.8359375) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)
        true = 255 * (1.055 * (nits / 203) ** (1 / 2.4) - 0.055)
        errors.append(rgb_of(plain_frame(luma, 512, 512, 10), PQ).mean() - true)
    assert abs(np.mean(errors)) < 0.2


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_hdr_is_tone_mapped(tmp_path: Path, transfer: int) -> None:
    tags = {"color_trc": transfer, "color_primaries": BT2020, "colorspace": BT2020}
    path = write_film(tmp_path / "hdr.mp4", plain((150, 150, 150)), codec="libx265", pixels="yuv420p10le", tags=tags)
    (pixel,) = np.unique(next(film_frames(path)).rgb().reshape(-1, 3), axis=0)
    expected = tone_mapped(np.full((1, 1, 3), round(150 / 255 * WHITE_CODE), np.uint16), transfer)[0, 0]
    assert np.abs(pixel.astype(int) - expected).max() <= 3
    assert np.ptp(pixel) <= 2  # grey stays grey


def test_tone_mapping_follows_the_standards() -> None:
    """100 nits have the sRGB code of 100/203 of the light (BT.2408), and the curve never falls."""
    for transfer, code in ((PQ, 0.5081), (HLG, 0.6296)):
        found = tone_mapped(np.full((1, 1, 3), round(code * WHITE_CODE), np.uint16), transfer)
        assert np.abs(found.astype(int) - 186).max() <= 1, transfer
        ramp = np.repeat(np.arange(0, 65536, 64, dtype=np.uint16)[None, :, None], 3, axis=2)
        grey = tone_mapped(ramp, transfer)[0, :, 0].astype(int)
        assert (np.diff(grey) >= 0).all()
        assert grey[0] == 0
        assert grey[-1] == 255


def test_oblong_pixels_become_square(tmp_path: Path) -> None:
    path = write_film(tmp_path / "dv.mp4", plain((9, 9, 9)), tags={"sample_aspect_ratio": 2})
    assert next(film_frames(path)).rgb().shape == (96, 320, 3)
    assert film_size(path) == (96, 320)


@pytest.mark.parametrize(
    ("content", "why"), [(b"", "the file is empty"), (b"no film", "not a film that can be read")], ids=["empty", "text"]
)
def test_what_is_no_film(tmp_path: Path, content: bytes, why: str) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(content)
    with pytest.raises(QuerySplatError, match=why):
        list(film_frames(path))


def test_a_title_that_is_not_utf_8(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", plain((9, 9, 9)))
    content = path.read_bytes()
    assert b"Lavf" in content
    path.write_bytes(content.replace(b"Lavf", b"\xe6avf"))
    assert len(list(film_frames(path))) > 0


def test_a_compression_that_nobody_knows(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", plain((9, 9, 9)))
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz9"))
    with pytest.raises(QuerySplatError, match="compression is not known"):
        list(film_frames(path))


def test_a_cut_off_film_gives_what_it_has(tmp_path: Path) -> None:
    """As after a dead battery, of a format that has no table at its end."""
    path = write_film(tmp_path / "film.webm", pan(range(0, 400, 10)), codec="libvpx-vp9")
    whole = len(list(film_frames(path)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    assert 5 < len(list(film_frames(path))) < whole


def test_evenly_spaced_frames(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", pan(range(0, 200, 10)))
    assert [photo.name for photo in evenly_spaced_frames(path, 7, 96)] == [f"{i:06d}.png" for i in range(0, 20, 3)]
    assert max(evenly_spaced_frames(path, 1, 96)[0].pixels.shape) == 96


def test_frames_ahead_are_not_looked_for_from_the_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_film(tmp_path / "long.mp4", pan(range(60)), tags={"gop_size": 10})
    stamps = [frame.pts for frame in film_frames(path)]
    decoded = 0

    def counted(*arguments: Any) -> Iterator[FilmFrame]:
        nonlocal decoded
        for frame in film_frames(*arguments):
            decoded += 1
            yield frame

    monkeypatch.setattr(films, "film_frames", counted)
    read_ahead(path, stamps[45:48])
    assert decoded <= 15
    assert frame_pixels(path, stamps[46]).shape == (144, 192, 3)
    assert decoded <= 15
