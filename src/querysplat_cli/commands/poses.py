"""What `poses` does: the errors of one set of cameras against another."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from querysplat_cli.commands.requests import PosesRequest
from querysplat_cli.evaluation.colmap_reference import estimate_with_colmap
from querysplat_cli.evaluation.poses import compare_cameras, draw_trajectories
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.figures import check_drawing
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.files import refuse_existing, writable
from querysplat_cli.scene.formats.known import find_known_cameras, is_llff, read_known_cameras
from querysplat_cli.scene.formats.transforms import listed_paths
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.lenses import pinhole_photos
from querysplat_cli.scene.match_cameras import matched_names
from querysplat_cli.scene.orientation import upright_camera
from querysplat_cli.scene.photo_files import PhotoFile, check_photo_files, read_photo_files
from querysplat_cli.scene.photo_names import names_a_photo
from querysplat_cli.scene.photos import LONGEST_SIDE, PICTURE_FOLDERS, find_photos, load_photos
from querysplat_cli.scene.views import Photo


def compare(request: PosesRequest, stages: Stages) -> tuple[dict[str, Any], str]:
    """The errors of the first set of cameras, in degrees and in units of the second set, and the second set's name.

    Raises QuerySplatError unless the request has either a second set or `colmap`.
    """
    if (request.second is None) != request.colmap:
        raise QuerySplatError("give two sets of cameras, or one and --colmap", "See `querysplat poses --help`.")
    if request.plot:
        check_drawing(request.plot)
        refuse_existing([request.plot], force=request.force)
    # COLMAP may take long, and the drawing comes after it.
    with writable(request.plot.parent) if request.plot else nullcontext():
        return _compared(request, stages)


def _compared(request: PosesRequest, stages: Stages) -> tuple[dict[str, Any], str]:
    files = {name: file for place in (request.second, request.first) if place for name, file in _files(place).items()}
    first = _upright(_rigid_cameras(request.first), files)
    if request.second:
        second, name = _upright(_rigid_cameras(request.second), files), str(request.second)
    else:
        with stages("photos") as progress:
            photos = _photos(request.first, list(files.values()), progress)
            first, photos = _as_pinholes(first, photos)
        second, name = estimate_with_colmap(photos, seed=request.seed, stages=stages), "COLMAP"
    errors = compare_cameras(first, second)
    if request.plot:
        draw_trajectories(errors, request.plot, (str(request.first), name))
    return errors.summary(), name


def _rigid_cameras(place: Path) -> dict[str, PhotoCamera]:
    """The cameras in or at `place`. Raises QuerySplatError where one of them is no rigid motion."""
    cameras = read_known_cameras(place, fisheye=True)
    wrong = [name for name, camera in cameras.items() if not is_rigid(camera.w2c)]
    if wrong:
        raise QuerySplatError(
            f"{place}: the camera of {shown(wrong[0])} is no rigid motion", "Mend it or leave it out."
        )
    return cameras


def _upright(cameras: dict[str, PhotoCamera], files: Mapping[str, PhotoFile]) -> dict[str, PhotoCamera]:
    """The cameras for the upright photos, where these are known. Those of COLMAP are for the stored ones."""
    pairs = matched_names({name: file.path for name, file in files.items()}, cameras)
    return {**cameras, **{key: upright_camera(cameras[key], files[name]) for name, key in pairs.items()}}


def _as_pinholes(cameras: dict[str, PhotoCamera], photos: list[Photo]) -> tuple[dict[str, PhotoCamera], list[Photo]]:
    """The cameras and photos, with pinhole views in place of fisheye photos, which COLMAP's defaults place badly."""
    if not any(camera.fisheye for camera in cameras.values()):
        return cameras, photos
    keys = matched_names({photo.name: photo.path for photo in photos}, cameras)
    own = {photo.name: upright_camera(cameras[keys[photo.name]], photo) for photo in photos if photo.name in keys}
    views, straight = pinhole_photos(photos, own, "auto")
    found = {keys[name]: replace(camera, file=own[name].file) for name, camera in (straight or {}).items()}
    return {**cameras, **found}, views


def _files(place: Path) -> dict[str, PhotoFile]:
    """The photos of which the scene in or at `place` was made, by name; none where it is no scene."""
    return read_photo_files((place if place.is_dir() else place.parent) / "photos.json")


def _photos(place: Path, files: Sequence[PhotoFile], progress: Progress) -> list[Photo]:
    """The photos that the cameras in or at `place` belong to.

    Those of a scene are `files`, of which it was made. The small pictures in its folder have too little detail.
    """
    if files:
        check_photo_files(files)
        return [file.load(LONGEST_SIDE) for file in files]
    folder = place if place.is_dir() else place.parent
    source = find_known_cameras(place)
    paths = {} if source.is_dir() or is_llff(source) else listed_paths(source)
    listed = {name: source.parent / path for name, path in paths.items() if names_a_photo(path)}
    there = {name: file for name, file in listed.items() if file.is_file()}
    if there:
        return load_photos(list(there.values()), LONGEST_SIDE, progress, list(there))[0]
    beside = [folder / name for name in PICTURE_FOLDERS if (folder / name).is_dir()]
    try:
        return load_photos(find_photos(beside[:1] or [folder]), LONGEST_SIDE, progress)[0]
    except QuerySplatError as error:
        hint = f"Put the photos into {folder / PICTURE_FOLDERS[0]}, or compare with another set of cameras."
        raise QuerySplatError(f"--colmap needs the photos of {place}: {error.message}", hint) from error
