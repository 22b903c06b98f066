"""Photos of wide lenses become pinhole views before anything else looks at them."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from querysplat_cli.runtime.choices import Lens
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.masks import WHOLLY
from querysplat_cli.scene.photos import Keep
from querysplat_cli.scene.resample import PinholeView, fisheye_view, panorama_views
from querysplat_cli.scene.views import Photo

PANORAMA_SHAPE = 1, 2


def pinhole_photos(
    photos: Sequence[Photo],
    known: Mapping[str, PhotoCamera] | None,
    lens: Lens,
    keep: Keep = lambda photo: photo,
) -> tuple[list[Photo], dict[str, PhotoCamera] | None]:
    """The photos and their known cameras, with pinhole views in place of fisheye photos and panoramas.

    A photo with a fisheye camera becomes one view of the same name and pose. A panorama becomes several, which are
    named after it. It is one where its file says so, and with `lens` "equirectangular". `keep` stores the views as it
    stores photos. Raises QuerySplatError when such a photo is not twice as wide as high, when a panorama has a known
    camera, and when one of its views has the name of another photo.
    """
    found: list[Photo] = []
    cameras = dict(known) if known is not None else None
    for photo in photos:
        camera = cameras.get(photo.name) if cameras is not None else None
        if photo.panorama or lens == "equirectangular":
            _check_panorama(photo, known)
            found += map(keep, _faces(photo))
        elif cameras is not None and camera and camera.fisheye and same_shape(_size(photo), _size(camera)):
            view = _view_of(rescaled(camera, photo.height, photo.width))
            straight = keep(shown_part(photo, view))
            cameras[photo.name] = _pinhole(camera.w2c, straight)
            found.append(straight)
        else:
            found.append(photo)
    names = Counter(photo.name for photo in found)
    if twice := [name for name, count in names.items() if count > 1]:
        why = f"{twice[0]} is the name of a photo, and of a view of a panorama"
        raise QuerySplatError(why, "Rename the photo.")
    return found, cameras


def shown_part(photo: Photo, view: PinholeView) -> Photo:
    """The part of a wide photo that `view` shows, with its mask and its focal length."""
    mask = None
    if photo.mask is not None:
        mask = view.picture(photo.mask.astype(np.float32)) >= WHOLLY
    focal = view.focal[0] * photo.width
    return replace(photo, pixels=view.picture(photo.pixels), mask=mask, focal=focal, panorama=False, view=view)


def same_panorama(one: Photo, other: Photo) -> bool:
    """Whether two photos are views of one panorama, so that no depth can be measured between them."""
    return one.view is not None and other.view is not None and (one.path, one.pts) == (other.path, other.pts)


def pinhole_width(camera: PhotoCamera) -> float:
    """The width of the pinhole view that a photo with this fisheye camera becomes, in the photo's own pixels.

    Raises QuerySplatError as `fisheye_view`.
    """
    return camera.width * _view_of(camera).size[1]


def _view_of(camera: PhotoCamera) -> PinholeView:
    return fisheye_view((*camera.focal, *camera.principal), camera.distortion, camera.height, camera.width)


def _pinhole(w2c: np.ndarray, photo: Photo) -> PhotoCamera:
    """The camera of a pinhole view."""
    assert photo.view is not None
    scale = photo.width / photo.view.size[1]
    (fx, fy), (cx, cy) = photo.view.focal, photo.view.principal
    nothing = (0.0, 0.0, 0.0, 0.0)
    focal, principal = (fx * scale, fy * scale), (cx * scale, cy * scale)
    return PhotoCamera(w2c, focal, principal, nothing, photo.height, photo.width)


def _faces(photo: Photo) -> Iterator[Photo]:
    name = PurePath(photo.name)
    for number, view in enumerate(panorama_views()):
        yield replace(shown_part(photo, view), name=str(name.with_name(f"{name.stem}_{number}{name.suffix}")))


def _check_panorama(photo: Photo, known: Mapping[str, PhotoCamera] | None) -> None:
    if not same_shape(_size(photo), PANORAMA_SHAPE):
        raise QuerySplatError(
            f"{photo.name} is {photo.width} × {photo.height}, and a panorama of 360° is twice as wide as high",
            "Leave --lens equirectangular out, or give panoramas alone.",
        )
    if known is not None:
        raise QuerySplatError(
            f"--poses: {photo.name} is a panorama of 360°, whose camera is estimated", "Leave it out."
        )


def _size(picture: Photo | PhotoCamera) -> tuple[int, int]:
    return picture.height, picture.width
