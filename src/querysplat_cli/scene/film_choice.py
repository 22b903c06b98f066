"""Which frames of films become photos: the sharpest of each stretch of motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from querysplat_cli.scene.film_survey import FilmSurvey
from querysplat_cli.scene.policy import FILM_POLICY


@dataclass(frozen=True)
class FilmChoice:
    """Rows of a survey, ascending, and how many other frames of the film are blurred."""

    survey: FilmSurvey
    rows: tuple[int, ...]
    blurred: int

    @property
    def left_out(self) -> str:
        """Why the other frames are left out, as a phrase; empty where there is none."""
        rest = self.survey.frames - len(self.rows)
        reasons = {"blurred": self.blurred, "close to those used": rest - self.blurred}
        phrase = ", ".join(f"{count:,} {reason}" for reason, count in reasons.items() if count)
        return f"{rest:,} of its {self.survey.frames:,} frames: {phrase}" if rest else ""


def choose_frames(surveys: Sequence[FilmSurvey], most: int | None = None) -> list[FilmChoice]:
    """Frames of each film, at equal steps of motion in all films.

    `most` is the most frames of all films together, though each film gives at least one. None takes one for each of
    the policy's steps, within its limits.
    """
    whole = sum(float(survey.travel[-1]) for survey in surveys)

    def step_of(frames: int) -> float:
        steps = frames - len(surveys)
        return max(FILM_POLICY.least_step, whole / steps) if steps > 0 else np.inf

    if most is None:
        step = max(min(FILM_POLICY.step, step_of(FILM_POLICY.fewest_frames)), step_of(FILM_POLICY.most_frames))
    else:
        step = step_of(most)
    return [_choose(survey, step) for survey in surveys]


def _choose(survey: FilmSurvey, step: float) -> FilmChoice:
    whole = float(survey.travel[-1])
    count = 1 + int(whole / step + 1e-6)
    places = np.linspace(0, whole, count) if count > 1 else np.array([whole / 2])
    spacing = whole / max(1, count - 1) or 1.0
    rows = sorted({row for place in places if (row := _sharpest(survey, place, spacing)) is not None})
    blurred = _blurred(survey.sharpness)
    kept = _without_blurred(rows, blurred)
    return FilmChoice(survey, tuple(kept), int(blurred.sum()) - int(blurred[kept].sum()))


def _sharpest(survey: FilmSurvey, place: float, spacing: float) -> int | None:
    """The sharpest frame near a place of the motion; None where the picture jumps over it."""
    distance = np.abs(survey.travel - place) / spacing
    for reach in (FILM_POLICY.sharpest_within, 0.5 + 1e-9):
        near = np.flatnonzero(distance <= reach)
        if len(near):
            return int(near[np.argmax(survey.sharpness[near])])
    return None


def _blurred(sharpness: np.ndarray) -> np.ndarray:
    reach = FILM_POLICY.sharpness_neighbours
    usual = [np.median(sharpness[max(0, row - reach) : row + reach + 1]) for row in range(len(sharpness))]
    return np.asarray(sharpness < FILM_POLICY.blurred * np.array(usual))


def _without_blurred(rows: Sequence[int], blurred: np.ndarray) -> list[int]:
    """The rows without blurred ones, but never two neighbours left out, so that frames still overlap."""
    kept: list[int] = []
    skipped = False
    for row in rows:
        skipped = bool(blurred[row]) and not skipped and len(rows) > 1
        if not skipped:
            kept.append(row)
    return kept or list(rows[:1])
