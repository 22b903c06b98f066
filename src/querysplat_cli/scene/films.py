"""Films: MP4, MOV, WebM and what else FFmpeg reads. Frames are found again by their presentation time stamp (pts)."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.film_colours import rgb_of
from querysplat_cli.scene.photos import FILM_SUFFIXES
from querysplat_cli.scene.views import Photo

GIVE_A_FILM = "Give an MP4, MOV or WebM film."
PACKED = (cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
MOST_PACKED_BYTES = 1 << 29
"""So many bytes of frames are kept as JPEG. Others are decoded anew."""


@dataclass(frozen=True)
class FilmFrame:
    """A decoded picture as it is stored: not upright, in the film's own colours.

    `pts` is in units of the film's own clock, `seconds` is the same time.
    """

    pts: int
    seconds: float
    picture: av.VideoFrame
    transfer: int
    primaries: int
    pixel_aspect: float

    def grey(self, longer_side: int) -> np.ndarray:
        """8-bit grey [height, width], reduced, not upright."""
        scale = min(1.0, longer_side / max(self.picture.width, self.picture.height))
        width, height = round(self.picture.width * scale), round(self.picture.height * scale)
        return np.asarray(self.picture.reformat(width=width, height=height, format="gray").to_ndarray())

    def rgb(self) -> np.ndarray:
        """8-bit sRGB [height, width, 3], upright, with square pixels."""
        pixels = rgb_of(self.picture, self.transfer, self.primaries)
        if self.pixel_aspect != 1:
            size = round(pixels.shape[1] * self.pixel_aspect), pixels.shape[0]
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(np.rot90(pixels, round(self.picture.rotation / 90)))


def is_film(path: Path) -> bool:
    return path.suffix.lower() in FILM_SUFFIXES


def film_frames(path: Path, start: int | None = None) -> Iterator[FilmFrame]:
    """The frames of a film in the order in which they are shown. Damaged ones are left out.

    With `start`, from a key frame at or before that pts on, and without frames that have none. Raises QuerySplatError
    when the file is no film.
    """
    with _opened(path) as (container, stream):
        if start is not None:
            container.seek(start, stream=stream)
        codec, aspect = stream.codec_context, float(stream.sample_aspect_ratio or 1)
        colours = int(codec.color_trc or 0), int(codec.color_primaries or 0)
        rate = float(stream.average_rate or 25)
        for number, picture in enumerate(_pictures(container, stream)):
            stamped = picture.pts is not None and picture.time is not None
            if start is not None and not stamped:
                continue  # its number is not known
            pts, seconds = (picture.pts, picture.time) if stamped else (number, number / rate)
            yield FilmFrame(pts or 0, float(seconds), picture, *colours, aspect)


def film_length(path: Path) -> int | None:
    """About how many frames a film has; None where it does not state that."""
    with _opened(path) as (_, stream):
        if stream.frames:
            return stream.frames
        seconds = stream.duration and stream.time_base and stream.duration * stream.time_base
        return round(seconds * stream.average_rate) if seconds and stream.average_rate else None


def film_size(path: Path) -> tuple[int, int]:
    """(height, width) of the upright frames, in square pixels."""
    frame = next(film_frames(path), None)
    if frame is None:
        raise QuerySplatError(f"{path}: a film without a picture", GIVE_A_FILM)
    height, width = frame.picture.height, round(frame.picture.width * frame.pixel_aspect)
    return (height, width) if round(frame.picture.rotation / 90) % 2 == 0 else (width, height)


def frame_pixels(path: Path, pts: int) -> np.ndarray:
    """The frame of this pts, as `FilmFrame.rgb`. Raises QuerySplatError when the film has none."""
    packed = _PACKED.get(path, pts)
    if packed is None:
        read_ahead(path, {pts})
        packed = _PACKED.get(path, pts)
    if packed is None:
        raise QuerySplatError(f"{path} has no frame at pts {pts}: it is another film", "Put the right film there.")
    pixels = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return np.ascontiguousarray(pixels[..., ::-1])


def read_ahead(path: Path, wanted: Iterable[int]) -> None:
    """Decode the frames of these pts, at least one, for `frame_pixels`: in one pass from the first of them on."""
    these = set(wanted)
    missing = _pack(film_frames(path, min(these)), path, these)
    _pack(film_frames(path), path, missing)  # the film may have no pts to jump to


def evenly_spaced_frames(path: Path, most: int, longest_side: int) -> tuple[Photo, ...]:
    """At most so many frames of a film, named by their numbers. Raises QuerySplatError when there is none."""
    total = sum(1 for _ in film_frames(path))
    step = max(1, -(-total // most))
    found = []
    for number, frame in enumerate(film_frames(path)):
        if number % step == 0:
            name = f"{number:06d}.png"
            found.append(Photo(name, Path(name), reduced(frame.rgb(), longest_side)))
    if not found:
        raise QuerySplatError(f"{path}: a film without a picture", GIVE_A_FILM)
    return tuple(found)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            if not container.streams.video:
                raise QuerySplatError(f"{path}: a film without pictures, only sound", GIVE_A_FILM)
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise QuerySplatError(f"{path}: a film whose compression is not known here", GIVE_A_FILM)
            stream.thread_type = "AUTO"
            yield container, stream
    except (av.FFmpegError, OSError) as error:
        empty = path.is_file() and not path.stat().st_size
        why = "the file is empty" if empty else f"not a film that can be read: {error.strerror or error}"
        raise QuerySplatError(f"{path}: {why}", GIVE_A_FILM) from error


def _pictures(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    for packet in container.demux(stream):
        try:
            pictures = packet.decode()
        except av.error.InvalidDataError:
            continue
        yield from (picture for picture in pictures if isinstance(picture, av.VideoFrame) and not picture.is_corrupt)


class _PackedFrames:
    """JPEGs of the frames that were decoded last, up to a number of bytes."""

    def __init__(self, most_bytes: int) -> None:
        self._most, self._bytes = most_bytes, 0
        self._found: OrderedDict[tuple[Path, int, int], bytes] = OrderedDict()

    def get(self, path: Path, pts: int) -> bytes | None:
        return self._found.get(self._key(path, pts))

    def add(self, path: Path, pts: int, packed: bytes) -> None:
        self._found[self._key(path, pts)] = packed
        self._bytes += len(packed)
        while self._bytes > self._most and len(self._found) > 1:
            self._bytes -= len(self._found.popitem(last=False)[1])

    @staticmethod
    def _key(path: Path, pts: int) -> tuple[Path, int, int]:
        return path.resolve(), path.stat().st_mtime_ns if path.is_file() else 0, pts


_PACKED = _PackedFrames(MOST_PACKED_BYTES)


def _pack(frames: Iterator[FilmFrame], path: Path, wanted: set[int]) -> set[int]:
    """Pack the wanted ones of `frames`, and stop after the last of them; returns those that were not found."""
    missing = {pts for pts in wanted if _PACKED.get(path, pts) is None}
    for frame in frames if missing else ():
        if frame.pts in missing:
            packed = cv2.imencode(".jpg", np.ascontiguousarray(frame.rgb()[..., ::-1]), PACKED)[1]
            _PACKED.add(path, frame.pts, packed.tobytes())
            missing.discard(frame.pts)
            if not missing:
                break
    return missing
