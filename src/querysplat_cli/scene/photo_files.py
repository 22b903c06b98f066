"""The photos that a scene was made of: where they lie, and how their lenses bend them.

A scene is made of small pictures. These entries find the photos again, for an optimisation on larger ones.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.runtime.tables import STRICT, from_tables
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, same_shape
from querysplat_cli.scene.decoding import longer_side, orientation_of, reduced
from querysplat_cli.scene.films import film_size, frame_pixels
from querysplat_cli.scene.lenses import shown_part
from querysplat_cli.scene.masks import Overlay, spread
from querysplat_cli.scene.photos import load_photo
from querysplat_cli.scene.resample import PinholeView
from querysplat_cli.scene.undistort import on_canvas, undistorted
from querysplat_cli.scene.views import Photo, PhotoSource, Views

MAKE_AGAIN = "Make the scene again."
PUT_BACK = "Put the photo back, or make the scene again."
OVERSAMPLING = 2
"""Photos are straightened at so many times the size of their pictures, where they have the pixels, and then reduced.
Straightening blurs by about a pixel of its own size."""
DETAIL_SCALE = 2.0
"""Detail of a working picture is its difference from itself, blurred by so many pixels."""
SAME_DETAIL = 0.4
"""Pictures whose detail correlates less are of different photos: neighbours of fortress, dtu106, kermit and fox have at
most 0.37, and photos that were made brighter, saved again or smoothed at least 0.55."""
LEAST_DETAIL = 1.0
"""Grey levels. Pictures with less detail, such as those of a white wall, are not compared."""


@dataclass(frozen=True)
class PhotoFile:
    """One photo's file and lens, an entry of photos.json.

    `pts` is the presentation time stamp of a film's frame; None for a photo. `view` is the part of a wide photo that
    this one shows; None for the whole of an ordinary one. `overlay` is what lies over the picture of the file.

    focal, principal: (fx, fy) and (cx, cy) in pixels of a photo of `height` × `width`, pixel centres at +0.5. The file
    may hold more pixels of the same shape.
    distortion: OpenCV's (k1, k2, p1, p2).
    """

    __pydantic_config__ = STRICT

    name: str
    path: Path
    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: tuple[float, float, float, float]
    height: int
    width: int
    pts: int | None = None
    view: PinholeView | None = None
    overlay: Overlay | None = None

    @classmethod
    def of(cls, name: str, source: PhotoSource, camera: PhotoCamera) -> "PhotoFile":
        focal, principal = tuple(map(float, camera.focal)), tuple(map(float, camera.principal))
        distortion = tuple(map(float, camera.distortion))
        lens = focal, principal, distortion, camera.height, camera.width
        return cls(name, source.path.absolute(), *lens, source.pts, source.view, source.overlay)  # type: ignore[arg-type]

    @property
    def lens(self) -> PhotoCamera:
        """A camera with this lens, at the origin."""
        return PhotoCamera(np.eye(4), self.focal, self.principal, self.distortion, self.height, self.width)

    def full_size(self) -> tuple[int, int]:
        """(height, width) of the picture in the file, or of the part of it that the photo shows."""
        if self.pts is not None:
            whole = film_size(self.path)
        else:
            scale = longer_side(self.path) / max(self.height, self.width) or 1.0
            whole = round(self.height * scale), round(self.width * scale)
        return self.view.shape(self.view.photo_width(max(whole))) if self.view else whole

    @property
    def orientation(self) -> int:
        """That of EXIF, which turns the stored pixels; 1 for frames of films, views and photos that are gone."""
        whole = self.pts is None and self.view is None
        return orientation_of(self.path) if whole and self.path.is_file() else 1

    def load(self, max_side: int) -> Photo:
        """The photo, reduced to a longer side of at most `max_side`. Raises QuerySplatError when it has changed."""
        photo = self._load(self.view.photo_side(max_side) if self.view else max_side).under(self.overlay)
        if self.view:
            photo = shown_part(photo, self.view)
        if not same_shape((photo.height, photo.width), (self.height, self.width)):
            raise QuerySplatError(f"{self.path} has another shape than when the scene was made", MAKE_AGAIN)
        return photo

    def _load(self, max_side: int) -> Photo:
        """The whole picture of the file."""
        if self.pts is not None:
            return Photo(self.name, self.path, reduced(frame_pixels(self.path, self.pts), max_side), pts=self.pts)
        photo = load_photo(self.path, self.name, max_side)
        if not isinstance(photo, Photo):
            raise QuerySplatError(f"{self.path}: {photo.why}", PUT_BACK)
        return photo


@dataclass(frozen=True)
class _Listing:
    __pydantic_config__ = STRICT

    photos: tuple[PhotoFile, ...]


def photo_files(
    names: Sequence[str], cameras: Sequence[PhotoCamera] | None, sources: Mapping[str, PhotoSource]
) -> tuple[PhotoFile, ...]:
    """The files of views by their names; none where the views show photos without resampling (no `cameras`)."""
    return tuple(PhotoFile.of(name, sources[name], camera) for name, camera in zip(names, cameras or (), strict=False))


def write_photo_files(path: Path, files: Sequence[PhotoFile]) -> None:
    entries = [{**asdict(file), "path": str(file.path)} for file in files]
    for entry in entries:
        for key in ("pts", "view", "overlay"):
            if entry[key] is None:
                del entry[key]
    path.write_text(json.dumps({"photos": entries}, indent=1) + "\n")


def read_photo_files(path: Path) -> dict[str, PhotoFile]:
    """Files by photo name; none where there is no such list. Raises QuerySplatError when it is damaged."""
    if not path.is_file():
        return {}
    found = {}
    files = from_tables(_Listing, read_json(path, MAKE_AGAIN), what="list of photos", docs="docs/cli.md").photos
    for file in files:
        fault = next(filter(None, (part.fault() for part in (file.lens, file.view, file.overlay) if part)), "")
        if fault or "\0" in str(file.path):
            raise QuerySplatError(f"{path}: the lens of {file.name} makes no sense: {fault}", MAKE_AGAIN)
        found[file.name] = file
    return found


def check_photo_files(files: Sequence[PhotoFile]) -> None:
    """Raise QuerySplatError, in one line, when photos are gone."""
    gone = [file.path for file in files if not file.path.is_file()]
    if gone:
        raise QuerySplatError(
            f"{len(gone)} of the {len(files)} photos of this scene are gone, such as {gone[0]}",
            "Put them back where they were, or make the scene again.",
        )


def large_views(files: Sequence[PhotoFile], views: Views, cameras: Cameras, max_size: int) -> tuple[Views, Cameras]:
    """The pictures of `views` at a longer side of at most `max_size`, as uint8, and `cameras` for them.

    The cameras keep their pose and focal length, which optimisation may have corrected. What takes no part in `views`
    takes none here. Photos are read and straightened one at a time. Raises QuerySplatError when a file holds another
    photo than that of its view.
    """
    pictures, masks, scales = [], [], []
    for view, (file, (height, width)) in enumerate(zip(files, views.sizes, strict=True)):
        one, _ = undistorted([file.load(OVERSAMPLING * max_size)], [file.lens], max_size=max_size)
        ((rows, columns),) = one.sizes
        picture, shown = one.images[0, :, :rows, :columns], views.masks[view, :height, :width]
        if not _alike(picture, views.picture(view)[:, :height, :width], shown):
            raise QuerySplatError(f"{file.path} shows something else than when the scene was made", PUT_BACK)
        pictures.append((picture * 255).round().clamp(0, 255).to(torch.uint8))
        masks.append(one.masks[0, :rows, :columns] & ~_hidden(shown, rows, columns))
        scales.append(torch.tensor([columns / width, rows / height, 1.0]))
    K = torch.stack(scales)[:, :, None] * cameras.K
    sizes = tuple((mask.shape[0], mask.shape[1]) for mask in masks)
    large = on_canvas(zip(pictures, masks, strict=True), views.names, sizes, torch.uint8)
    return large, Cameras(cameras.w2c, K, *large.masks.shape[1:])


def _alike(
    large: Float[Tensor, "3 rows columns"], small: Float[Tensor, "3 height width"], shown: Bool[Tensor, "height width"]
) -> bool:
    """Whether two pictures have the same detail where they are shown. Colours and exposure may differ."""
    height, width = shown.shape
    mask = shown.numpy()
    if not mask.any():
        return True
    greys = [
        cv2.resize(each.mean(0).numpy() * 255, (width, height), interpolation=cv2.INTER_AREA) for each in (large, small)
    ]
    details = [(grey - cv2.GaussianBlur(grey, (0, 0), DETAIL_SCALE))[mask] for grey in greys]
    one, other = (detail - detail.mean() for detail in details)
    if max(one.std(), other.std()) < LEAST_DETAIL:
        return True
    return float((one * other).mean()) > SAME_DETAIL * float(one.std() * other.std())


def _hidden(shown: Bool[Tensor, "height width"], rows: int, columns: int) -> Bool[Tensor, "rows columns"]:
    """What a working picture does not show, at a larger size; without an edge of one pixel, which large masks know."""
    inner = spread(cv2.MORPH_ERODE, (~shown).numpy(), 3).astype(np.uint8)
    return torch.from_numpy(cv2.resize(inner, (columns, rows), interpolation=cv2.INTER_NEAREST) > 0)
