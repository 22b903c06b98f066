"""Cameras of a COLMAP model: cameras, images and points3D as .bin or .txt, read and written."""

import shutil
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.colmap_files import check_binary, unreadable
from querysplat_cli.scene.formats.colmap_text import check_images, damage
from querysplat_cli.scene.formats.point_cloud import PointCloud
from querysplat_cli.scene.photo_names import names_a_photo, short_names

MODEL_FOLDERS = ("", "0", "sparse", "sparse/0", "colmap/sparse/0")
"""Where a model may be in a folder that the user gives."""
DISTORTION_PARAMETERS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0, 1),
    "OPENCV": (0, 1, 2, 3),
}
"""For each lens model, which of OpenCV's (k1, k2, p1, p2) its extra parameters are."""
FISHEYE_PARAMETERS = {
    "SIMPLE_RADIAL_FISHEYE": (0,),
    "RADIAL_FISHEYE": (0, 1),
    "OPENCV_FISHEYE": (0, 1, 2, 3),
}
"""The same of OpenCV's fisheye (k1, k2, k3, k4)."""


@dataclass(frozen=True)
class Observed:
    """Points, and for photos by name the pixels [k, 2] at which they observe the points of these `rows` [k]."""

    cloud: PointCloud
    pixels: Mapping[str, np.ndarray] = field(default_factory=dict)
    rows: Mapping[str, np.ndarray] = field(default_factory=dict)


def find_model(folder: Path) -> Path | None:
    """The folder with a COLMAP model in or under `folder`."""
    places = [folder / name for name in MODEL_FOLDERS]
    return next((place for place in places if any(map(Path.is_file, _model_files(place)))), None)


def read_colmap(folder: Path, *, fisheye: bool = False) -> dict[str, PhotoCamera]:
    """Cameras by photo name (with its folder only where names repeat) of the model in `folder`.

    Raises QuerySplatError when the model is damaged, or a lens has more than k1, k2, p1, p2. With `fisheye`, fisheye
    lenses are read, too.
    """
    try:
        return _cameras(folder, DISTORTION_PARAMETERS | (FISHEYE_PARAMETERS if fisheye else {}))
    except QuerySplatError:
        raise
    except Exception as error:  # damage can raise anything in COLMAP's classes
        raise unreadable(folder, str(error)) from error


def _cameras(folder: Path, lenses: Collection[str]) -> dict[str, PhotoCamera]:
    model = _opened(folder)
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    if not images:
        raise QuerySplatError(f"{folder}: the COLMAP model places no photo", "Give another model.")
    unnamed = [image.name for image in images if not names_a_photo(image.name)]
    if unnamed:
        raise QuerySplatError(f"{folder}: {shown(unnamed[0])} is no name of a photo", "Export it again.")
    names = short_names([Path(image.name) for image in images])
    cameras = {}
    for name, image in zip(names, images, strict=True):
        camera = _without_idle_terms(model.cameras[image.camera_id])
        if camera.model_name not in lenses:
            raise QuerySplatError(
                f"{folder}: the lens model of {name} is {camera.model_name}; supported are {', '.join(lenses)}",
                "Undistort the photos first, with `colmap image_undistorter`.",
            )
        found = replace(photo_camera(image, camera), file=image.name, as_stored=True)  # COLMAP does not turn photos
        if found.fault() or not np.isfinite(found.w2c).all():
            why = found.fault() or "its pose is not a number"
            raise QuerySplatError(f"{folder}: the camera of {name} makes no sense: {why}", "Export it again.")
        cameras[name] = found
    return cameras


def _without_idle_terms(camera: Any) -> Any:
    """An OPENCV camera in place of a FULL_OPENCV one whose k3 to k6 are 0."""
    if camera.model_name != "FULL_OPENCV" or any(camera.params[8:]):
        return camera
    size = {"width": camera.width, "height": camera.height}
    return load_pycolmap().Camera(model="OPENCV", **size, params=camera.params[:8], camera_id=camera.camera_id)


def photo_camera(image: Any, camera: Any) -> PhotoCamera:
    """A placed pycolmap.Image with its pycolmap.Camera, whose lens model is one of those above."""
    w2c = np.eye(4)
    w2c[:3] = image.cam_from_world().matrix()
    distortion = [0.0, 0.0, 0.0, 0.0]
    places = (DISTORTION_PARAMETERS | FISHEYE_PARAMETERS)[camera.model_name]
    for place, index in zip(places, camera.extra_params_idxs(), strict=True):
        distortion[place] = float(camera.params[index])
    k1, k2, k3, k4 = distortion
    return PhotoCamera(
        w2c=w2c,
        focal=(float(camera.focal_length_x), float(camera.focal_length_y)),
        principal=(float(camera.principal_point_x), float(camera.principal_point_y)),
        distortion=(k1, k2, k3, k4),
        height=int(camera.height),
        width=int(camera.width),
        fisheye=camera.model_name in FISHEYE_PARAMETERS,
    )


def write_colmap(
    folder: Path, cameras: Mapping[str, PhotoCamera], *, points: Observed | None = None, text: bool = False
) -> None:
    """Write a model into the empty `folder`. Photos with equal intrinsics share a camera.

    Raises QuerySplatError where `text` cannot hold a name.
    """
    if text:
        _check_text(folder, cameras)
    pycolmap = load_pycolmap()
    model = pycolmap.Reconstruction()
    numbers: dict[tuple[object, ...], int] = {}
    for image_id, (name, camera) in enumerate(cameras.items(), start=1):
        kind = "OPENCV_FISHEYE" if camera.fisheye else "OPENCV" if any(camera.distortion) else "PINHOLE"
        intrinsics = (*camera.focal, *camera.principal, *(() if kind == "PINHOLE" else camera.distortion))
        key = (kind, camera.width, camera.height, *intrinsics)
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            size = {"width": camera.width, "height": camera.height}
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(model=kind, **size, params=list(intrinsics), camera_id=numbers[key])
            )
        image = pycolmap.Image(name=name, camera_id=numbers[key], image_id=image_id)
        if points:
            image.points2D = [pycolmap.Point2D(pixel) for pixel in points.pixels.get(name, ())]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.w2c[:3]))
    if points:
        _add_points(model, points, {name: image_id for image_id, name in enumerate(cameras, start=1)})
    (model.write_text if text else model.write_binary)(folder)


def _add_points(model: Any, points: Observed, image_ids: Mapping[str, int]) -> None:
    pycolmap = load_pycolmap()
    tracks = [pycolmap.Track() for _ in points.cloud.places]
    for name, image_id in image_ids.items():
        for feature, row in enumerate(points.rows.get(name, ())):
            tracks[row].add_element(image_id, feature)
    for place, colour, track in zip(points.cloud.places, points.cloud.colours, tracks, strict=True):
        model.add_point3D(place.astype(np.float64), track, colour)
    model.update_point_3d_errors()


def copy_colmap(source: Path, folder: Path, *, text: bool = False) -> None:
    """Write the model in `source`, points included, into the empty `folder`, binary or as text."""
    model = _opened(source)
    if text:
        _check_text(folder, [image.name for image in model.images.values()])
    (model.write_text if text else model.write_binary)(folder)


def _check_text(folder: Path, names: Iterable[str]) -> None:
    """Raise QuerySplatError for a name that is not read back from text, where spaces end a name."""
    spaced = next((name for name in names if len(name.split()) > 1), None)
    if spaced:
        raise QuerySplatError(
            f"{folder}: COLMAP's text form cannot hold the space in {shown(spaced)}", "Leave --text out."
        )


def _opened(folder: Path) -> Any:
    kind = _kind(folder)
    if kind and not (folder / f"cameras{kind}").is_file():
        raise unreadable(folder, f"cameras{kind} is missing")
    check_binary(folder)
    if kind == ".txt":
        check_images(folder)
    with scratch_folder() as scratch:
        whole = _with_points(folder, kind, scratch)
        try:
            return load_pycolmap().Reconstruction(whole)
        except Exception as error:  # damage can raise anything in COLMAP's parser, in the words of its code
            reason = damage(folder) if kind == ".txt" else None
            raise unreadable(folder, reason or "its files do not fit each other") from error


def _kind(folder: Path) -> str | None:
    """The suffix of the files of the model in `folder`."""
    return next((file.suffix for file in _model_files(folder) if file.is_file()), None)


def _with_points(folder: Path, kind: str | None, scratch: Path) -> Path:
    """`folder`, or `scratch` with a copy of its model and no points: COLMAP reads no model without points3D."""
    if kind is None or (folder / f"points3D{kind}").is_file():
        return folder
    for part in ("cameras", "images", "rigs", "frames"):
        if (folder / f"{part}{kind}").is_file():
            shutil.copyfile(folder / f"{part}{kind}", scratch / f"{part}{kind}")
    (scratch / f"points3D{kind}").write_bytes(bytes(8) if kind == ".bin" else b"")  # a count of 0
    return scratch


def _model_files(folder: Path) -> list[Path]:
    return [folder / f"images{suffix}" for suffix in (".bin", ".txt")]
