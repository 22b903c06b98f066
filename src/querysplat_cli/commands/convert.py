"""What `convert` does: Gaussians from one kind of file to another, and cameras from one kind to another."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from querysplat_cli.commands.convert_gaussians import convert_gaussians
from querysplat_cli.commands.convert_levels import LEVELS
from querysplat_cli.commands.convert_request import Conversion
from querysplat_cli.commands.exported_points import observed_points, points_entry, points_without_photos
from querysplat_cli.pipeline.gaussian_files import READERS, STREAMED, WRITERS, file_of_scene, is_streamed
from querysplat_cli.pipeline.scene_folder import SCENE_FOLDER, keep_others, write_images
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.files import FolderKind, atomic_folder, refuse_existing, with_name
from querysplat_cli.scene.formats.colmap import copy_colmap, write_colmap
from querysplat_cli.scene.formats.known import MODEL_KINDS, find_known_cameras, is_llff, read_known_cameras
from querysplat_cli.scene.formats.mesh import MESH_KINDS
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.lenses import pinhole_photos
from querysplat_cli.scene.match_cameras import cameras_of, match_cameras
from querysplat_cli.scene.orientation import stored_camera, upright_camera
from querysplat_cli.scene.photo_files import read_photo_files
from querysplat_cli.scene.photo_names import short_names
from querysplat_cli.scene.photos import WHOLE, find_photos, load_photo
from querysplat_cli.scene.pictures import stored_names
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import LeftOut

MODEL = FolderKind(
    tuple(f"{part}{kind}" for part in ("cameras", "images", "points3D") for kind in MODEL_KINDS),
    tuple(f"{part}{kind}" for part in ("rigs", "frames") for kind in MODEL_KINDS),
)
"""Files of a COLMAP model."""


def convert(request: Conversion, stages: Stages | None = None) -> dict[str, Any]:
    """Write `request.target`, and return what was written, as the dict that --json prints.

    `clean` comes first. `up` becomes −y, and `scale` multiplies lengths. Boxes and spheres are in the units and
    axes of the result, and `prune_to` comes last. With `photos`, cameras and photos become a scene folder. Raises
    QuerySplatError, and writes nothing, on bad input.
    """
    request = _with_file(request)
    given = [path.resolve() for path in (request.source, request.photos) if path]
    if request.target.is_dir() and any(path.is_relative_to(request.target.resolve()) for path in given):
        raise QuerySplatError(f"{request.target} holds what is to be converted", "Choose another target.")
    refuse_existing([request.target], force=request.force, kind=_kind_of_folder(request))
    if request.source.suffix.lower() in READERS or is_streamed(request.source):
        if request.photos or request.text:
            raise QuerySplatError("--photos and --text are for cameras", "Leave them out.")
        return convert_gaussians(request, stages or Stages())
    if request.photos and request.text:
        raise QuerySplatError("--text is for COLMAP models, --photos for scene folders", "Leave one of them out.")
    if request.changes or request.geometry or request.levels:
        what = "options that turn, scale or cut, --points, --mesh and --levels are for Gaussians"
        raise QuerySplatError(what, "Give a .ply, .spz, .sog or .glb.")
    return _convert_cameras(request)


def _with_file(request: Conversion) -> Conversion:
    """With the Gaussians of a scene in place of its folder, where the target is a file of Gaussians or of a mesh."""
    kinds = {*WRITERS, STREAMED, *MESH_KINDS}
    file = file_of_scene(with_name(request.source))
    folder = request.source.is_dir() and not is_streamed(request.source)
    wanted = folder and file.is_file() and request.target.suffix.lower() in kinds
    return replace(request, source=file) if wanted else request


def _kind_of_folder(request: Conversion) -> FolderKind | None:
    """Of the target, if that is a folder."""
    if request.target.suffix.lower() == STREAMED:
        return LEVELS
    if request.photos:
        return SCENE_FOLDER
    return None if request.target.suffix else MODEL


def _convert_cameras(request: Conversion) -> dict[str, Any]:
    source = find_known_cameras(request.source)
    photos = find_photos([request.photos]) if request.photos else []
    given = read_known_cameras(source, fisheye=True, photos=photos)
    cameras = {name: camera for name, camera in given.items() if is_rigid(camera.w2c)}
    left_out = [vars(LeftOut(name, "its camera is no rigid motion")) for name in given if name not in cameras]
    if not cameras:
        raise QuerySplatError(f"{source}: no camera of it is a rigid motion", "Export it again.")
    counts: dict[str, Any] = {}
    if request.target.suffix.lower() == ".json" and not request.photos:
        write_transforms(request.target, cameras)
    elif request.target.suffix:
        hint = "Use a .json, or a folder; for Gaussians, give their file."
        raise QuerySplatError(f"{request.target}: not a kind of file for cameras", hint)
    elif request.photos:
        made = _make_scene_folder(request.target, cameras, request.photos, photos)
        return {**made, "left_out": [*made["left_out"], *left_out]}
    else:
        with atomic_folder(request.target) as draft:
            if source.is_dir():
                copy_colmap(source, draft, text=request.text)
            else:
                points = None
                if request.source.is_dir() and not is_llff(source):
                    cameras = _with_lenses(source.parent, cameras)
                    points = observed_points(source, cameras) or points_without_photos(source.parent)
                write_colmap(draft, cameras, points=points, text=request.text)
                counts = points_entry(points)
    return {"target": str(request.target), "cameras": len(cameras), **counts, "left_out": left_out}


def _with_lenses(folder: Path, cameras: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    """The cameras of a scene for its photos as they are stored, with their lenses and sizes, where these are known."""
    found = dict(cameras)
    for name, file in read_photo_files(folder / "photos.json").items():
        if name in cameras:
            lens = rescaled(file.lens, *file.full_size()) if file.path.is_file() else file.lens
            found[name] = stored_camera(replace(lens, w2c=cameras[name].w2c), file.orientation)
    return found


def _make_scene_folder(
    target: Path, cameras: Mapping[str, PhotoCamera], place: Path, files: Sequence[Path]
) -> dict[str, Any]:
    """Write a scene folder: the cameras in their own frame, and the photos, undistorted at their own size."""
    named = dict(zip(short_names(files), files, strict=True))
    matched = cameras_of(named, cameras)
    pictures, kept = stored_names(list(named)), dict[str, PhotoCamera]()
    left_out: list[LeftOut] = []
    with atomic_folder(target) as draft:
        for name, file in named.items():
            photo = load_photo(file, name, WHOLE)
            if isinstance(photo, LeftOut):
                left_out.append(photo)
                continue
            own = {name: upright_camera(matched[name], photo)} if name in matched else {}
            if any(camera.fisheye for camera in own.values()):
                (photo,), views_of_own = pinhole_photos([photo], own, "auto")
                own = views_of_own or {}
            usable, unusable = match_cameras([photo], own)
            left_out += unusable
            for camera in usable.values():
                views, straight = undistorted([photo], [camera], max_size=max(photo.height, photo.width))
                write_images(draft / "images", views, pictures, target / "images")
                kept[name] = PhotoCamera.pinhole(camera.w2c, straight.K[0].double().numpy(), *views.sizes[0])
        if not kept:
            raise QuerySplatError(
                f"{place}: no photo of it has a camera ({left_out[0].name}: {left_out[0].why})",
                f"Names must agree: the first camera is that of {next(iter(cameras))}.",
            )
        write_transforms(draft / "cameras.json", kept, pictures.__getitem__)
        keep_others(target, draft)
    used = {camera.file for camera in matched.values()}
    left_out += [
        LeftOut(name, "there is no photo of it") for name, camera in cameras.items() if camera.file not in used
    ]
    return {"target": str(target), "cameras": len(kept), "left_out": [vars(each) for each in left_out]}
