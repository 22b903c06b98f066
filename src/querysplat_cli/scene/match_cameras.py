"""Cameras that the user gives, matched with the photos by name."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import PurePath

import numpy as np

from querysplat_cli.scene.cameras import PhotoCamera, same_shape
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.orientation import MIRRORED, upright_camera
from querysplat_cli.scene.photo_names import path_parts, stated_parts
from querysplat_cli.scene.photos import SUFFIXES
from querysplat_cli.scene.views import LeftOut, Photo

Parts = tuple[str, ...]
"""The folders and the file of a path. The file is without the suffix of its format."""


def cameras_of(paths: Mapping[str, PurePath], given: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    """The given cameras by the names of their photos, as `matched_names` pairs them."""
    return {name: given[key] for name, key in matched_names(paths, given).items()}


def matched_names(paths: Mapping[str, PurePath], given: Mapping[str, PhotoCamera]) -> dict[str, str]:
    """The names in `given` by those in `paths`, which has photos' paths. Photos without a camera are not in it.

    A camera belongs to the photo whose path ends as the path in the camera's file does, over the most folders. Suffixes
    may differ. Nothing is matched where two are as good, nor where one folder would become another that has photos or
    cameras of its own.
    """
    photos = {name: _parts(path_parts(path)) for name, path in paths.items()}
    places = {key: _parts(stated_parts(camera.file or key)) for key, camera in given.items()}
    by_file = defaultdict(list)
    for key, place in places.items():
        by_file[place[-1]].append(key)
    wanted: dict[str, dict[str, tuple[int, bool]]] = defaultdict(dict)
    folders = _folders(photos.values()), _folders(places.values())
    for name, photo in photos.items():
        agreement = {
            key: (_common(photo, places[key]), PurePath(given[key].file or key).name == paths[name].name)
            for key in by_file[photo[-1]]
        }
        best = _only_best(agreement)
        if best and not _other_folder(photo, places[best], agreement[best][0], *folders):
            wanted[best][name] = agreement[best]
    owners = {key: _only_best(claims) for key, claims in wanted.items()}
    return {name: key for key, name in owners.items() if name}


def cameras_of_photos(photos: Sequence[Photo], given: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    """As `cameras_of`, and for the upright pixels of these photos. A film's frame has no file, so its name counts."""
    paths = {photo.name: photo.path if photo.pts is None else PurePath(photo.name) for photo in photos}
    found = cameras_of(paths, given)
    return {photo.name: upright_camera(found[photo.name], photo) for photo in photos if photo.name in found}


def match_cameras(
    photos: Sequence[Photo], given: Mapping[str, PhotoCamera]
) -> tuple[dict[int, PhotoCamera], list[LeftOut]]:
    """The cameras given by photo name by photo number, rotations made orthonormal, and photos without a usable one."""
    cameras, left_out = {}, []
    for number, photo in enumerate(photos):
        camera = given.get(photo.name)
        fault = _fault(photo, camera) if camera else "no camera is given for it"
        if camera and not fault:
            cameras[number] = replace(camera, w2c=rigid(camera.w2c))
        else:
            left_out.append(LeftOut(photo.name, fault))
    return cameras, left_out


def rigid(w2c: np.ndarray) -> np.ndarray:
    """The matrix [4, 4] with the nearest orthonormal rotation, in float64."""
    u, _, vt = np.linalg.svd(w2c[:3, :3])
    exact = np.array(w2c, dtype=np.float64)
    exact[:3, :3] = u @ vt
    return exact


def _fault(photo: Photo, camera: PhotoCamera) -> str:
    if not is_rigid(camera.w2c):
        return "its given camera is no rigid motion"
    if camera.as_stored and photo.orientation in MIRRORED:
        return "EXIF says that it is mirrored: save it as it is shown, and find its camera again"
    if not same_shape((photo.height, photo.width), (camera.height, camera.width)):
        return f"it is {photo.width} × {photo.height}, its given camera {camera.width} × {camera.height}"
    return ""


def _parts(parts: Sequence[str]) -> Parts:
    file = PurePath(parts[-1])
    return *parts[:-1], file.stem if file.suffix.lower() in SUFFIXES else file.name


def _common(one: Parts, other: Parts) -> int:
    """How many of the last parts agree."""
    pairs = zip(reversed(one), reversed(other), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _only_best(agreement: Mapping[str, tuple[int, bool]]) -> str | None:
    """The name that agrees most; None where there is none, or two agree as much."""
    best = max(agreement.values(), default=None)
    names = [name for name, each in agreement.items() if each == best]
    return names[0] if len(names) == 1 else None


def _folders(paths: Iterable[Parts]) -> set[tuple[int, str]]:
    """Each folder and how many parts stand behind it."""
    return {(behind, part) for parts in paths for behind, part in enumerate(reversed(parts)) if behind}


def _other_folder(
    photo: Parts, place: Parts, common: int, of_photos: set[tuple[int, str]], of_cameras: set[tuple[int, str]]
) -> bool:
    """Whether the first folders that differ are two that both sides tell apart."""
    if common in (len(photo), len(place)):
        return False
    return (common, photo[-1 - common]) in of_cameras or (common, place[-1 - common]) in of_photos
