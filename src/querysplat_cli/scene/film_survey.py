"""How sharp the frames of a film are, and how far the picture moves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.films import GIVE_A_FILM, film_frames, film_length
from querysplat_cli.scene.policy import FILM_POLICY

SHARPNESS_SIDE, TRACKING_SIDE = 640, 320
"""Longer sides, in pixels, at which sharpness and motion are measured."""
MOST_CORNERS = 200
FEWEST_CORNERS = 8
CORNER_QUALITY = 0.01
CORNER_DISTANCE = 8
ROUND_TRIP = 1.0
"""A corner that is followed there and back comes back to within so many pixels."""
SAME_GREY = 1.5
"""Pictures without corners are the same where grey levels differ by less, on average."""


@dataclass(frozen=True)
class FilmSurvey:
    """The frames of a film that were looked at, in order.

    `travel` never falls. It is how far the picture has moved since the first frame, in longer sides. `sharpness` is
    the variance of the Laplacian. `frames` counts all frames of the film.
    """

    path: Path
    pts: np.ndarray
    seconds: np.ndarray
    sharpness: np.ndarray
    travel: np.ndarray
    frames: int


def survey_film(path: Path, progress: Callable[[float], None]) -> FilmSurvey:
    """Look at the frames of a film. Raises QuerySplatError when it is not a film that can be read."""
    total, count, last = film_length(path), 0, -np.inf
    motion = _Motion()
    found: list[tuple[int, float, float, float]] = []
    for frame in film_frames(path):
        count += 1
        if frame.seconds - last < 0.99 / FILM_POLICY.frames_per_second:
            continue
        last = frame.seconds
        grey = frame.grey(SHARPNESS_SIDE)
        found.append((frame.pts, frame.seconds, _sharpness(grey), motion.travel_to(grey)))
        progress(min(1.0, count / total) if total else 0.0)
    if not found:
        raise QuerySplatError(f"{path}: a film without a picture", GIVE_A_FILM)
    pts, seconds, sharpness, travel = zip(*found, strict=True)
    return FilmSurvey(path, np.array(pts), np.array(seconds), np.array(sharpness), np.array(travel), count)


def _sharpness(grey: np.ndarray) -> float:
    calm = cv2.GaussianBlur(grey, (0, 0), 1.0)  # noise is no detail
    return float(cv2.Laplacian(calm, cv2.CV_32F).var())


class _Motion:
    """Follows corners from a key frame on, and takes a new key frame after half a step.

    A shaking hand does not add up, because motion is measured from the key frame. A change of the picture's size is a
    whole step: no corner is followed across it.
    """

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._start = self._now = np.zeros((0, 1, 2), np.float32)
        self._travel_of_key = self._travel = 0.0
        self._corners = 0

    def travel_to(self, picture: np.ndarray) -> float:
        """How far the picture has moved since the first frame, in longer sides."""
        grey = reduced(picture, TRACKING_SIDE)
        before, self._before = self._before, grey
        if before is None:
            self._new_key(grey)
            return 0.0
        if before.shape != grey.shape:
            self._travel += FILM_POLICY.step
            self._new_key(grey)
            return self._travel
        moved = self._followed(before, grey)
        self._travel = max(self._travel, self._travel_of_key + moved)
        few = len(self._now) < FILM_POLICY.lost_share * self._corners
        if moved > FILM_POLICY.step / 2 or few or self._corners < FEWEST_CORNERS:
            self._new_key(grey)
        return self._travel

    def _new_key(self, grey: np.ndarray) -> None:
        corners = cv2.goodFeaturesToTrack(grey, MOST_CORNERS, CORNER_QUALITY, CORNER_DISTANCE)
        found = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._start = self._now = found
        self._corners, self._travel_of_key = len(self._start), self._travel

    def _followed(self, before: np.ndarray, grey: np.ndarray) -> float:
        """Motion since the key frame; a whole step where the corners are lost."""
        if len(self._now) < FEWEST_CORNERS:
            same = float(cv2.absdiff(before, grey).mean()) < SAME_GREY
            return 0.0 if same else FILM_POLICY.step
        there, found, _ = cv2.calcOpticalFlowPyrLK(before, grey, self._now, None)  # type: ignore[call-overload]
        back, returned, _ = cv2.calcOpticalFlowPyrLK(grey, before, there, None)  # type: ignore[call-overload]
        near = np.linalg.norm(back - self._now, axis=2)[:, 0] < ROUND_TRIP
        kept = near & (found[:, 0] == 1) & (returned[:, 0] == 1)
        self._start, self._now = self._start[kept], there[kept]
        if len(self._now) < max(FEWEST_CORNERS, FILM_POLICY.lost_share * self._corners):
            return FILM_POLICY.step
        return float(np.median(np.linalg.norm(self._now - self._start, axis=2))) / max(grey.shape)
