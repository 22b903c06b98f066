"""Cameras in nerfstudio's transforms.json, which DL3DV uses too, and in our own cameras.json of that form.

Files hold OpenGL camera-to-world matrices (x right, y up, z backward); everything else here is OpenCV
world-to-camera. Principal points count from the picture's corner: pixel centres at +0.5.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json, shown
from querysplat_cli.scene.cameras import LONGEST_SIDE, Cameras, PhotoCamera
from querysplat_cli.scene.files import write_json
from querysplat_cli.scene.formats.listed_pictures import by_name, with_size
from querysplat_cli.scene.formats.stated_frames import as_entry, stated_frame
from querysplat_cli.scene.formats.transforms_frame import FISHEYE, LENS_KEYS, frame_camera, is_rigid, opengl_from_opencv
from querysplat_cli.scene.photo_names import names_a_photo, short_names, stated_parts
from querysplat_cli.scene.pictures import stored_names
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views


@dataclass(frozen=True)
class NamedCameras:
    """Cameras of a cameras.json, with each photo's name and size (height, width) on their canvas.

    `files` are the pictures, by their paths in `images/`; it is empty where there are none.
    """

    names: tuple[str, ...]
    cameras: Cameras
    sizes: tuple[tuple[int, int], ...]
    files: tuple[str, ...] = ()

    def transformed(self, frame: Sim3 | None) -> "NamedCameras":
        """In the frame that `frame` maps to (None: where they are)."""
        return replace(self, cameras=self.cameras.transformed(frame)) if frame else self


def read_transforms(
    path: Path, *, fisheye: bool = False, home: Traversable | None = None, photos: Sequence[Path] = ()
) -> dict[str, PhotoCamera]:
    """Cameras by photo name, with the lens distortion and the picture size that the file states.

    Where it states no size, it is that of the listed picture, upright: in `home`, which by default is the file's
    folder, or else of those of the `photos` that have its name.

    A photo's name is the file name in `file_path` (the folder often does not exist as written), or in our own
    `photo`, with as much of the folder as makes it unique. Intrinsics may be given for each
    frame. A matrix that is no rigid motion is passed on as it is: the encoder leaves that photo out by name.
    Raises QuerySplatError when the file is unreadable, incomplete, or states a lens other than OpenCV's. With
    `fisheye`, OpenCV's fisheye lenses are read, too.
    """
    content, home, named = _load(path), home or path.parent, by_name(photos)
    return {
        name: replace(
            frame_camera(path, name, _with_size({**content, **frame}, home, named), fisheye=fisheye),
            file=_photo(path, frame),
            as_stored=frame.get("as_stored") is True,
            depth_map=_depth_map(path, frame),
        )
        for name, frame in _named_frames(path, content).items()
    }


def listed_paths(path: Path) -> dict[str, str]:
    """What `path` has as `file_path` of each photo, by the names of `read_transforms`. Raises like it."""
    return {name: with_slashes(str(frame["file_path"])) for name, frame in _named_frames(path, _load(path)).items()}


def listed_files(folder: Path) -> set[str]:
    """The cameras.json of `folder` and the pictures that it lists, by their paths in the folder.

    Empty where there is no such file, or it is no list of cameras.
    """
    path = folder / "cameras.json"
    try:
        return {path.name, *listed_paths(path).values()}
    except QuerySplatError:
        return set()


def write_cameras(
    path: Path,
    cameras: Cameras,
    views: Views,
    *,
    heldout: tuple[Views, Cameras] | None = None,
    frame: Sim3 | None = None,
) -> dict[str, str]:
    """Write pinhole cameras of undistorted pictures; `read_cameras` gives the same back within 1e-6.

    The pictures are the undistorted ones in `images/`. Where a picture's file has another name than its photo, or
    one with a backslash, `photo` is the photo's name. Held-out frames are under `heldout_frames`. `canvas` is the
    (height, width) that all share. `frame` maps the frame of the cameras to that of the file, which also keeps it, as
    `working_frame`. Returns the pictures' names in `images/` by those of the photos.
    """
    files = stored_names([*views.names, *(heldout[0].names if heldout else ())])
    content = {
        "camera_model": "PINHOLE",
        "canvas": [cameras.height, cameras.width],
        **({"working_frame": as_entry(frame)} if frame else {}),
        "frames": _frames(cameras, views, files, frame),
        **({"heldout_frames": _frames(heldout[1], heldout[0], files, frame)} if heldout else {}),
    }
    write_json(path, content)
    return files


def write_transforms(
    path: Path, cameras: Mapping[str, PhotoCamera], file_of: Callable[[str], str] = lambda name: name
) -> None:
    """Write cameras with their distortion; `read_transforms` gives the same back within rounding.

    The pictures are in `images/`. `file_of` turns a photo's name into its picture's file name. `as_stored` marks
    cameras of pixels that EXIF's orientation has not turned.
    """
    bent = {camera.fisheye for camera in cameras.values()}
    frames = []
    for name, camera in cameras.items():
        (fx, fy), (cx, cy) = camera.focal, camera.principal
        intrinsics = {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        intrinsics |= zip(LENS_KEYS[camera.fisheye], camera.distortion, strict=True)
        matrix = opengl_from_opencv(camera.w2c).tolist()
        lens = {"camera_model": FISHEYE} if camera.fisheye and len(bent) > 1 else {}
        stored = {"as_stored": True} if camera.as_stored else {}
        frames.append({**_picture(name, file_of(name)), **lens, **intrinsics, **stored, "transform_matrix": matrix})
    write_json(path, {"camera_model": FISHEYE if bent == {True} else "OPENCV", "frames": frames})


def read_cameras(path: Path, kind: torch.dtype = torch.float32) -> tuple[NamedCameras, NamedCameras | None]:
    """Cameras as numbers of a `kind`, and the held-out ones if there are any, of a cameras.json or a transforms.json.

    The views are pinholes: a distortion in the file is not applied. Raises QuerySplatError as
    `read_transforms` does, and for a matrix that is no rigid motion.
    """
    content = _load(path)
    return _both(path, content, Sim3.identity(), kind)


def read_working_cameras(path: Path) -> tuple[NamedCameras, NamedCameras | None, Sim3 | None]:
    """The cameras of a cameras.json in the frame in which its scene was made, and the way from there to the file's.

    That is None where the two frames are one. Raises as `read_cameras`.
    """
    content = _load(path)
    frame = stated_frame(path, content.get("working_frame"))
    return *_both(path, content, frame or Sim3.identity(), torch.float32), frame


def working_frame(path: Path) -> Sim3 | None:
    """The third part of what `read_working_cameras` gives."""
    return stated_frame(path, _load(path).get("working_frame"))


def _both(
    path: Path, content: dict[str, Any], frame: Sim3, kind: torch.dtype
) -> tuple[NamedCameras, NamedCameras | None]:
    inputs = _named_cameras(path, content, content["frames"], frame, kind)
    heldout = content.get("heldout_frames")
    return inputs, _named_cameras(path, content, heldout, frame, kind) if heldout else None


def _frames(cameras: Cameras, views: Views, files: Mapping[str, str], frame: Sim3 | None) -> list[dict[str, Any]]:
    cameras = cameras.to(torch.float64)
    cameras = cameras.transformed(frame) if frame else cameras
    return [
        {
            **_picture(name, files[name]),
            "w": width,
            "h": height,
            "fl_x": float(K[0, 0]),
            "fl_y": float(K[1, 1]),
            "cx": float(K[0, 2]),
            "cy": float(K[1, 2]),
            "transform_matrix": opengl_from_opencv(w2c).tolist(),
        }
        for name, (height, width), K, w2c in zip(
            views.names, views.sizes, cameras.K.numpy(), cameras.w2c.numpy(), strict=True
        )
    ]


def _named_cameras(
    path: Path, content: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], frame: Sim3, kind: torch.dtype
) -> NamedCameras:
    """The cameras in the frame that `frame` maps to the file's."""
    names = tuple(_inside(_photo(path, entry)) for entry in frames)
    cameras = [frame_camera(path, name, {**content, **entry}) for name, entry in zip(names, frames, strict=True)]
    found = as_named(path, names, cameras, content.get("canvas")).transformed(frame.inverse())
    return replace(found, cameras=found.cameras.to(kind), files=tuple(_file(path, entry) for entry in frames))


def as_named(path: Path, names: Sequence[str], cameras: Sequence[PhotoCamera], canvas: Any = None) -> NamedCameras:
    """Cameras of `path` in float64, as pinholes, on the canvas that it states (None: the smallest that holds them).

    Raises QuerySplatError for a matrix that is no rigid motion, and a canvas that cannot hold the pictures.
    """
    for name, camera in zip(names, cameras, strict=True):
        if not is_rigid(camera.w2c):
            raise QuerySplatError(f"{path}: the matrix of {name} is no rigid motion", "Remove that frame.")
    sizes = tuple((camera.height, camera.width) for camera in cameras)
    height, width = _canvas(path, canvas, sizes)
    w2c = torch.from_numpy(np.stack([camera.w2c for camera in cameras]))
    K = torch.from_numpy(np.stack([camera.K for camera in cameras]))
    return NamedCameras(tuple(names), Cameras(w2c, K, height, width), sizes)


def _canvas(path: Path, stated: Any, sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """(height, width) of the canvas: the stated one, or the smallest that holds pictures of these sizes."""
    least = max(size[0] for size in sizes), max(size[1] for size in sizes)
    if stated is None:
        return least
    whole = isinstance(stated, list) and len(stated) == 2 and all(type(side) is int for side in stated)
    if not (whole and all(low <= side <= LONGEST_SIDE for low, side in zip(least, stated, strict=True))):
        raise QuerySplatError(f"{path}: the canvas {shown(stated)} cannot hold its pictures", "Export the file again.")
    return stated[0], stated[1]


def _picture(photo: str, file: str) -> dict[str, str]:
    return {"file_path": f"images/{file}", **({} if file == photo and "\\" not in file else {"photo": photo})}


def _named_frames(path: Path, content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The frames in `content` of `path`, held-out ones last, by the short names of their photos."""
    frames = [*content["frames"], *content.get("heldout_frames", [])]
    names = short_names([PurePosixPath(_photo(path, frame)) for frame in frames])
    return dict(zip(names, frames, strict=True))


def _with_size(frame: Mapping[str, Any], home: Traversable, named: Mapping[str, Sequence[Path]]) -> Mapping[str, Any]:
    file = frame["file_path"]
    return with_size(frame, with_slashes(file), home, named) if isinstance(file, str) else frame


def _photo(path: Path, frame: Any) -> str:
    if not isinstance(frame, dict) or "file_path" not in frame:
        raise QuerySplatError(f"{path}: a frame has no file_path", "Export the file again.")
    name = frame.get("photo", frame["file_path"])
    if not isinstance(name, str) or not names_a_photo(name):
        raise QuerySplatError(f"{path}: {shown(name)} is no name of a photo", "Export the file again.")
    return name if "photo" in frame else with_slashes(name)


def _depth_map(path: Path, frame: Mapping[str, Any]) -> Path | None:
    file = frame.get("depth_file_path")
    return path.parent / with_slashes(file) if isinstance(file, str) else None


def with_slashes(path: str) -> str:
    """A `file_path` that was written on Windows as others write it."""
    return path.replace("\\", "/")


def _file(path: Path, frame: Mapping[str, Any]) -> str:
    """The picture of a frame, by its path below the folder of the pictures."""
    file = frame["file_path"]
    if not isinstance(file, str) or not names_a_photo(file):
        raise QuerySplatError(f"{path}: {shown(file)} is no name of a picture", "Export the file again.")
    # In our own files a backslash is a part of the name.
    return _inside(file if "photo" in frame else with_slashes(file))


def _inside(name: str) -> str:
    """The path of a picture below the folder of the pictures, whatever folders the file names."""
    parts = stated_parts(name)
    return "/".join(parts[1:] if parts[0] == "images" and parts[1:] else parts)


def _load(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list) or not content["frames"]:
        raise QuerySplatError(
            f"{path}: no cameras in it (a list called `frames`)", "Give a file in nerfstudio's transforms.json form."
        )
    if not isinstance(content.get("heldout_frames", []), list):
        raise QuerySplatError(f"{path}: heldout_frames is no list", "Export the file again.")
    return content
