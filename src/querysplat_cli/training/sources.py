"""Sources of training scenes: procedural ones and captured ones. A draw gives photos, some of which are inputs."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.films import evenly_spaced_frames, is_film
from querysplat_cli.scene.formats.dataset import CapturedScene, fetch, find_scenes
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.config import SourceSettings
from querysplat_cli.training.outdoors import make_outdoors
from querysplat_cli.training.photographer import cast, wander
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.solids import Scene


@dataclass(frozen=True)
class Capture:
    """Photos of one scene in the order in which they were taken, the names of the inputs, and cameras where known."""

    name: str
    photos: tuple[Photo, ...]
    inputs: tuple[str, ...]
    known: Mapping[str, PhotoCamera] | None


@runtime_checkable
class Source(Protocol):
    """Scenes by number. A capture depends only on the seed, the scene and the draw."""

    def __len__(self) -> int: ...

    def capture(self, scene: int, draw: int) -> Capture:
        """Raises QuerySplatError when the scene cannot be used."""
        ...


def open_source(settings: SourceSettings) -> Source:
    """The source of these settings. Raises QuerySplatError when a place is missing or holds nothing."""
    return Procedural(settings) if settings.kind == "procedural" else Captured(settings)


def drawn_views(
    chance: np.random.Generator, settings: SourceSettings, frames: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ascending numbers of the inputs and of the targets among `frames` frames.

    Inputs are an interval apart; targets lie between the first and the last of them, and up to an interval beyond.
    Raises QuerySplatError when there are too few frames.
    """
    fewest, most = settings.inputs
    fitting = [n for n in range(fewest, most + 1) if n < frames]
    if not fitting:
        raise QuerySplatError(f"{frames} frames are too few for {fewest} inputs and a target")
    count = int(chance.choice(fitting))
    widest = max(1, (frames - 1) // max(count - 1, 1))
    low = min(settings.interval[0], widest)
    interval = int(chance.integers(low, min(settings.interval[1], widest) + 1))
    start = int(chance.integers(0, frames - (count - 1) * interval))
    inputs = tuple(start + i * interval for i in range(count))
    around = range(max(0, start - interval), min(frames, inputs[-1] + interval + 1))
    others = [frame for frame in around if frame not in inputs] or [i for i in range(frames) if i not in inputs]
    picked = chance.choice(others, min(settings.targets, len(others)), replace=False)
    return inputs, tuple(sorted(int(frame) for frame in picked))


class Procedural:
    """Ray-cast scenes with true cameras, photographed as by a phone: noise, exposure, blur, JPEG."""

    def __init__(self, settings: SourceSettings) -> None:
        self._settings = settings

    def __len__(self) -> int:
        return self._settings.scenes

    def capture(self, scene: int, draw: int) -> Capture:
        settings = self._settings
        chance = np.random.default_rng([settings.seed, scene, draw])
        # Twice as many cameras as photos, so that inputs may be next to one another or apart.
        frames = 2 * (settings.inputs[1] + settings.targets)
        inputs, targets = drawn_views(chance, settings, frames)
        side = int(chance.integers(settings.size[0], settings.size[1] + 1))
        height, width = round(side * chance.uniform(*TRAINING_POLICY.aspect)), side
        if chance.random() < TRAINING_POLICY.portrait_share:
            height, width = width, height
        made, cameras = self._scene(chance, frames, height, width)
        photos, known = [], {}
        imperfections = _Imperfections.drawn(chance)
        for frame in sorted({*inputs, *targets}):
            image = cast(made, cameras[[frame]])[0][0].permute(1, 2, 0).numpy()
            pixels = imperfections.photograph(image, chance)
            name = f"{frame:03d}.jpg"
            photos.append(Photo(name, Path(name), pixels))
            w2c, K = cameras.w2c[frame].double().numpy(), cameras.K[frame].double().numpy()
            known[name] = PhotoCamera.pinhole(w2c, K, height, width)
        names = tuple(f"{frame:03d}.jpg" for frame in inputs)
        return Capture(f"procedural {scene}", tuple(photos), names, known if settings.cameras == "posed" else None)

    def _scene(self, chance: np.random.Generator, frames: int, height: int, width: int) -> tuple[Scene, Cameras]:
        """A scene with free space for a camera path, and the cameras on that path."""
        for _ in range(TRAINING_POLICY.scene_tries):
            seed = int(chance.integers(2**31))
            made = make_room(seed) if chance.random() < TRAINING_POLICY.room_share else make_outdoors(seed)
            try:
                return made, wander(made, frames, seed, height, width)
            except ValueError:
                continue
        raise QuerySplatError(f"no scene of seed {self._settings.seed} has room for a camera path")


@dataclass(frozen=True)
class _Imperfections:
    """What a phone's camera does to a picture. The policy's fields of these names give the units."""

    exposure: float
    noise: float
    blur: float
    quality: int

    @staticmethod
    def drawn(chance: np.random.Generator) -> "_Imperfections":
        return _Imperfections(
            exposure=float(chance.choice(TRAINING_POLICY.exposures)),
            noise=float(chance.uniform(*TRAINING_POLICY.noise)),
            blur=float(chance.uniform(*TRAINING_POLICY.blur)),
            quality=int(chance.integers(*TRAINING_POLICY.jpeg_quality, endpoint=True)),
        )

    def photograph(self, picture: np.ndarray, chance: np.random.Generator) -> np.ndarray:
        """8-bit RGB [height, width, 3] of a picture in [0, 1]."""
        gain = np.exp(self.exposure * (chance.normal() + 0.3 * chance.normal(size=3)))
        soft = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), self.blur)
        grainy = soft * gain + chance.normal(0, 1, picture.shape) * self.noise * np.sqrt(np.clip(soft, 0.02, 1))
        pixels = np.rint(np.clip(grainy, 0, 1) * 255).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.quality]
        packed = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), quality)[1]
        found = cv2.imdecode(packed, cv2.IMREAD_COLOR)
        assert found is not None
        return np.ascontiguousarray(found[..., ::-1])


class Captured:
    """DL3DV, nerfstudio and COLMAP scenes, folders of photos, zips of those, and videos."""

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
        scenes = find_scenes(folders, settings.pictures) if folders else []
        self._scenes: list[CapturedScene | Path] = [*scenes, *films]

    def __len__(self) -> int:
        return len(self._scenes)

    def capture(self, scene: int, draw: int) -> Capture:
        settings, place = self._settings, self._scenes[scene]
        chance = np.random.default_rng([settings.seed, scene, draw])
        if isinstance(place, Path):
            film = _film(place)
            inputs, targets = drawn_views(chance, settings, len(film))
            photos = {frame: film[frame] for frame in sorted({*inputs, *targets})}
            return Capture(place.name, tuple(photos.values()), tuple(photos[frame].name for frame in inputs), None)
        inputs, targets = drawn_views(chance, settings, len(place.frames))
        chosen = sorted({*inputs, *targets})
        frames = [place.frames[i] for i in chosen]
        with scratch_folder() as scratch:
            loaded, unread = load_photos(fetch(frames, scratch), TRAINING_POLICY.longest_side)
        if unread:
            raise QuerySplatError(f"{place.name}: {unread[0].name}: {unread[0].why}", "Download the scene again.")
        named = [
            Photo(frame.name, photo.path, photo.pixels, photo.focal)
            for frame, photo in zip(frames, loaded, strict=True)
        ]
        if settings.cameras == "posed" and not place.cameras:
            raise QuerySplatError(f"{place.name} has no cameras", 'Use cameras = "free" for it.')
        known = place.cameras if settings.cameras == "posed" else None
        return Capture(place.name, tuple(named), tuple(place.frames[i].name for i in inputs), known)


@lru_cache(maxsize=1)
def _film(path: Path) -> tuple[Photo, ...]:
    return evenly_spaced_frames(path, TRAINING_POLICY.film_frames, TRAINING_POLICY.longest_side)
