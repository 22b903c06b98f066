"""Small films that tests write themselves."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np


def write_film(
    path: Path,
    pictures: Sequence[np.ndarray],
    *,
    milliseconds: Sequence[int] | None = None,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    rotation: int = 0,
    tags: dict[str, int] | None = None,
) -> Path:
    """A film of 8-bit RGB pictures, ten a second, or each shown from its `milliseconds` on.

    `rotation` is the counter-clockwise turn, in degrees, that players apply. `tags` are members of the codec's context,
    such as its colour transfer.
    """
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    with av.open(str(path), "w") as film:
        stream: Any = film.add_stream(codec, rate=10, options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, 1000)
        if rotation:
            stream.set_display_rotation(rotation)
        for name, value in (tags or {}).items():
            setattr(stream.codec_context, name, value)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.time_base = Fraction(1, 1000)
            frame.pts = milliseconds[number] if milliseconds else 100 * number
            film.mux(stream.encode(frame))
        film.mux(stream.encode())
    return path


def wide_picture(seed: int = 0, height: int = 144, width: int = 1200) -> np.ndarray:
    """Smooth noise with plenty of corners."""
    noise = np.random.default_rng(seed).integers(0, 256, (height // 6, width // 6, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC))


def pan(places: Sequence[float], width: int = 192) -> list[np.ndarray]:
    """Pictures of a camera that pans over a wide picture: its left edge at each of the places, in pixels."""
    whole = wide_picture()
    return [whole[:, round(place) : round(place) + width] for place in places]
