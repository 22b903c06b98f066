"""The photos of a scene: picture files, and the frames of films that show something new."""

from collections.abc import Sequence
from pathlib import Path

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.film_choice import FilmChoice, choose_frames
from querysplat_cli.scene.film_survey import FilmSurvey, survey_film
from querysplat_cli.scene.films import film_length, frame_pixels, is_film, read_ahead
from querysplat_cli.scene.photo_names import short_names
from querysplat_cli.scene.photos import LONGEST_SIDE, Keep, decoded_photos, load_photos, none_usable
from querysplat_cli.scene.views import LeftOut, Photo

AHEAD = 32
"""Frames that are decoded in one pass over their film: so many large ones are kept until they are read."""
LIVE_SUFFIXES = {".mov", ".mp4"}
"""Of the films of Live Photos: as phones store them, and as some programs and clouds export them."""
LIVE_FRAMES = 200
"""The film of a Live Photo has at most so many frames: it takes three seconds."""


def load_inputs(
    paths: Sequence[Path],
    frames: int | None = None,
    progress: Progress = lambda text, fraction: None,
    keep: Keep = lambda photo: photo,
) -> tuple[list[Photo], list[LeftOut]]:
    """Photos and chosen frames of films in the order of `paths`, and what is not used, with the reason.

    `frames` is the most frames of all films together; None lets the motion decide. A film has one entry for all its
    other frames. Photos are read and kept as by `load_photos`. Raises QuerySplatError when there is no usable photo at
    all, and when `frames` is given without a film.
    """
    live = [path for path in paths if _is_live(path, paths)]
    paths = [path for path in paths if path not in live]
    films = [path for path in paths if is_film(path)]
    beside = [LeftOut(path.name, "it is the film of the Live Photo beside it") for path in live]
    if not films:
        if frames:
            raise QuerySplatError("--frames is for films, and there is no film among the inputs", "Leave it out.")
        photos, left_out = load_photos(paths, progress=progress, keep=keep)
        return photos, [*beside, *left_out]
    names = dict(zip(paths, short_names(paths), strict=True))
    surveys, left_out = _surveyed(films, names, progress)
    found: dict[Path, list[Photo]] = {}
    for choice in choose_frames(surveys, frames):
        path = choice.survey.path
        progress(f"{names[path]}: reading {len(choice.rows)} frames", 1.0)
        found[path] = _frames(choice, names[path], keep)
        if choice.left_out:
            left_out.append(LeftOut(names[path], choice.left_out))
    pictures = [path for path in paths if path not in films]
    photos, unread = decoded_photos(pictures, [names[path] for path in pictures], LONGEST_SIDE, progress, keep)
    for photo in photos:
        found[photo.path] = [photo]
    left_out += [*beside, *unread]
    if not found:
        raise none_usable(left_out)
    return [photo for path in paths for photo in found.get(path, ())], left_out


def _is_live(path: Path, paths: Sequence[Path]) -> bool:
    """Whether a file is the short film that a phone stores beside a photo, under the name of the photo."""
    if path.suffix.lower() not in LIVE_SUFFIXES:
        return False
    named = [each for each in paths if each.parent == path.parent and each.stem.casefold() == path.stem.casefold()]
    if all(map(is_film, named)):
        return False
    try:
        frames = film_length(path)
    except QuerySplatError:
        return False
    return frames is not None and frames <= LIVE_FRAMES


def _surveyed(
    films: Sequence[Path], names: dict[Path, str], progress: Progress
) -> tuple[list[FilmSurvey], list[LeftOut]]:
    surveys, left_out = [], []
    for path in films:
        try:
            surveys.append(survey_film(path, lambda share, name=names[path]: progress(f"looking at {name}", share)))  # type: ignore[misc]
        except QuerySplatError as error:
            left_out.append(LeftOut(names[path], error.message.removeprefix(f"{path}: ")))
    return surveys, left_out


def _frames(choice: FilmChoice, name: str, keep: Keep) -> list[Photo]:
    path, survey = choice.survey.path, choice.survey
    stamps = [int(survey.pts[row]) for row in choice.rows]
    found = []
    for number, (row, pts) in enumerate(zip(choice.rows, stamps, strict=True)):
        if number % AHEAD == 0:
            read_ahead(path, stamps[number : number + AHEAD])
        pixels = reduced(frame_pixels(path, pts), LONGEST_SIDE)
        found.append(keep(Photo(f"{name}_{survey.seconds[row]:08.3f}.jpg", path, pixels, pts=pts)))
    return found
