"""Sources of training scenes: procedural ones and captured ones."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.films import evenly_spaced_frames, is_film
from querysplat_cli.scene.formats.dataset import CapturedScene, fetch, find_scenes
from querysplat_cli.scene.orientation import upright_camera
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.captures import Capture, drawn_views
from querysplat_cli.training.config import SourceSettings
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.procedural import Procedural

NAME_LENGTH = 40
"""Characters of a scene's name in the names of its samples' files."""
Walks = dict[tuple[tuple[Path, ...], str], list[CapturedScene]]
"""The scenes that were found, by the folders and the preferred folder of pictures."""
_walks: ContextVar[Walks | None] = ContextVar("_walks", default=None)


@runtime_checkable
class Source(Protocol):
    """Scenes by number. A capture depends only on the seed, the scene and the draw."""

    def __len__(self) -> int: ...

    def name(self, scene: int) -> str:
        """Part of a file's name. It stays the scene's when others are added."""
        ...

    def capture(self, scene: int, draw: int) -> Capture:
        """Raises QuerySplatError when the scene cannot be used."""
        ...


def open_source(settings: SourceSettings) -> Source:
    """The source of these settings. Raises QuerySplatError when a place is missing or holds nothing."""
    return Procedural(settings) if settings.kind == "procedural" else Captured(settings)


def notes_of(every: Iterable[SourceSettings]) -> list[str]:
    """What users should know about the captured scenes of these sources, which are looked for once for all stages.

    Raises as `open_source`.
    """
    distinct = {(each.places, each.pictures): each for each in every if each.kind == "captured"}
    return list(dict.fromkeys(note for each in distinct.values() for note in Captured(each).notes))


@contextmanager
def walked_once() -> Iterator[None]:
    """Inside, folders of captured scenes are walked the first time that a source of them is opened, and not again.

    So scenes that are added meanwhile are not seen, and a scene's number stays the same.
    """
    outer = _walks.get()
    token = _walks.set({} if outer is None else outer)
    try:
        yield
    finally:
        _walks.reset(token)


def _scenes_in(folders: Sequence[Path], pictures: str) -> list[CapturedScene]:
    """As `find_scenes`, unless `walked_once` remembers them."""
    walks, key = _walks.get(), (tuple(folders), pictures)
    if walks is None:
        return find_scenes(folders, pictures)
    if key not in walks:
        walks[key] = find_scenes(folders, pictures)
    return walks[key]


class Captured:
    """DL3DV, nerfstudio, COLMAP and LLFF scenes, folders of photos, zips of those, and videos."""

    def __init__(self, settings: SourceSettings) -> None:
        self._settings = settings
        places = [Path(place).expanduser() for place in settings.places]
        films = [place for place in places if is_film(place)]
        if missing := [film for film in films if not film.is_file()]:
            raise QuerySplatError(f"{missing[0]}: no such file", "Give a video, a scene, or a folder of scenes.")
        folders = [place for place in places if place not in films]
        if gone := [folder for folder in folders if not folder.exists()]:
            hint = """Name your own with --set 'data.sources.0.places=["/path/to/scenes"]'."""
            raise QuerySplatError(f"{gone[0]}: no such folder of scenes to train on", hint)
        scenes = _scenes_in(folders, settings.pictures) if folders else []
        self._scenes: list[CapturedScene | Path] = [*scenes, *films]

    @property
    def notes(self) -> list[str]:
        """What is missing or unusual, scene by scene."""
        scenes = [scene for scene in self._scenes if isinstance(scene, CapturedScene)]
        return [f"{scene.name}: {note}" for scene in scenes for note in scene.notes]

    def __len__(self) -> int:
        return len(self._scenes)

    def name(self, scene: int) -> str:
        """What can be read of the scene's name, and its key."""
        readable = re.sub(r"[^\w-]+", "_", self._scenes[scene].name)[:NAME_LENGTH]
        return f"{readable}-{self._key(scene):08x}"

    def _key(self, scene: int) -> int:
        """A number that depends on the scene alone. Scenes have one name each; films are told apart by their paths."""
        place = self._scenes[scene]
        which = str(place) if isinstance(place, Path) else place.name
        return int(hashlib.sha256(which.encode()).hexdigest()[:8], 16)

    def capture(self, scene: int, draw: int) -> Capture:
        settings, place = self._settings, self._scenes[scene]
        chance = np.random.default_rng([settings.seed, self._key(scene), draw])
        if isinstance(place, Path):
            film = _film(place)
            inputs, targets = drawn_views(chance, settings, len(film))
            photos = {frame: film[frame] for frame in sorted({*inputs, *targets})}
            return Capture(tuple(photos.values()), tuple(photos[frame].name for frame in inputs), None)
        if place.fault:
            raise QuerySplatError(place.fault, "Download the scene again.")
        inputs, targets = drawn_views(chance, settings, len(place.frames))
        chosen = sorted({*inputs, *targets})
        frames = [place.frames[i] for i in chosen]
        with scratch_folder() as scratch:
            loaded, unread = load_photos(fetch(frames, scratch), TRAINING_POLICY.longest_side)
        if unread:
            raise QuerySplatError(f"{place.name}: {unread[0].name}: {unread[0].why}", "Download the scene again.")
        named = [replace(photo, name=frame.name) for frame, photo in zip(frames, loaded, strict=True)]
        if settings.cameras == "posed" and not place.cameras:
            raise QuerySplatError(f"{place.name} has no cameras", 'Use cameras = "free" for it.')
        known = None
        if settings.cameras == "posed":
            pairs = ((frame.name, photo) for frame, photo in zip(frames, loaded, strict=True))
            known = {name: upright_camera(place.cameras[name], photo) for name, photo in pairs if name in place.cameras}
        return Capture(tuple(named), tuple(place.frames[i].name for i in inputs), known)


@lru_cache(maxsize=1)
def _film(path: Path) -> tuple[Photo, ...]:
    return evenly_spaced_frames(path, TRAINING_POLICY.film_frames, TRAINING_POLICY.longest_side)
