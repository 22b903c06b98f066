"""Lens distortion removed: photos as a pinhole camera would take them, on one canvas."""

from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, rescaled
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.masks import WHOLLY, resized_mask
from querysplat_cli.scene.views import Photo, Views

CANVAS_MULTIPLE = 12
"""The sides of the canvas are multiples of this many pixels: whole patches, and whole blocks of queries."""


def undistorted(photos: Sequence[Photo], cameras: Sequence[PhotoCamera], *, max_size: int) -> tuple[Views, Cameras]:
    """The photos without lens distortion, at a longer side of at most `max_size`, and their pinhole cameras.

    Each picture is the largest rectangle whose every pixel the photo covers, stretched to the photo's own shape, so
    that fx and fy differ slightly for a strongly distorting lens. It lies in the canvas's top-left corner. Pictures
    are never enlarged.
    """
    matrices: list[np.ndarray] = []
    sizes = tuple(_size_within(photo, max_size) for photo in photos)

    def pictures() -> Iterator[tuple[Tensor, Tensor | None]]:
        for photo, camera, (height, width) in zip(photos, cameras, sizes, strict=True):
            lens = rescaled(camera, photo.height, photo.width)
            flat, K = _straightened(photo.pixels, lens)
            if (height, width) != (photo.height, photo.width):
                # In float32: on 8 bits OpenCV rounds every mean, and halves always upwards.
                flat = cv2.resize(flat.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
            matrices.append(np.diag([width / photo.width, height / photo.height, 1.0]) @ K)
            yield torch.from_numpy(flat).permute(2, 0, 1).float() / 255, _straight_mask(photo, lens, height, width)
            release(photo)

    views = on_canvas(pictures(), tuple(photo.name for photo in photos), sizes)
    w2c = torch.from_numpy(np.stack([camera.w2c for camera in cameras])).float()
    return views, Cameras(w2c, torch.from_numpy(np.stack(matrices)).float(), *views.masks.shape[1:])


def on_canvas(
    pictures: Iterable[tuple[Tensor, Tensor | None]],
    names: tuple[str, ...],
    sizes: tuple[tuple[int, int], ...],
    kind: torch.dtype = torch.float32,
) -> Views:
    """Pictures [3, height, width] of type `kind`, each in the top-left corner of a canvas that holds the largest sides.

    With each comes its mask [height, width]; None where all of it takes part. The rest becomes black. `sizes` are
    (height, width). Pictures are taken one at a time.
    """
    height, width = (-(-max(side) // CANVAS_MULTIPLE) * CANVAS_MULTIPLE for side in zip(*sizes, strict=True))
    images = torch.zeros(len(sizes), 3, height, width, dtype=kind)
    masks = torch.zeros(len(sizes), height, width, dtype=torch.bool)
    for row, ((picture, part), (rows, columns)) in enumerate(zip(pictures, sizes, strict=True)):
        images[row, :, :rows, :columns] = picture if part is None else picture * part
        masks[row, :rows, :columns] = True if part is None else part
    return Views(images, masks, names, sizes)


def _size_within(photo: Photo, max_size: int) -> tuple[int, int]:
    scale = min(1.0, max_size / max(photo.height, photo.width))
    return max(1, round(photo.height * scale)), max(1, round(photo.width * scale))


def _straight_mask(photo: Photo, camera: PhotoCamera, height: int, width: int) -> Tensor | None:
    """The photo's mask without distortion, at this size."""
    if photo.mask is None:
        return None
    flat, _ = _straightened(photo.mask.astype(np.float32), camera)
    return torch.from_numpy(resized_mask(flat >= WHOLLY, height, width))


def _straightened(pixels: np.ndarray, camera: PhotoCamera) -> tuple[np.ndarray, np.ndarray]:
    """The photo without distortion at full size, and its K (pixel centres at +0.5)."""
    K = camera.K
    if not any(camera.distortion):
        return pixels, K
    left, top, right, bottom = _inscribed(camera, K)
    if not (left < right and top < bottom):
        raise QuerySplatError(
            f"a lens distortion of {', '.join(f'{k:g}' for k in camera.distortion)} folds the picture over itself",
            "Give the cameras with the lens that took the photos.",
        )
    height, width = pixels.shape[:2]
    fx, fy = width / (right - left), height / (bottom - top)
    straight = np.array([[fx, 0, -fx * left], [0, fy, -fy * top], [0, 0, 1.0]])
    maps = places_in_photo(camera, straight, height, width)
    return cv2.remap(pixels, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), straight


def places_in_photo(camera: PhotoCamera, K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Column and row [height, width] in the photo of `camera` for each pixel of a view with matrix K [3, 3].

    The view has no distortion and looks as the photo does. Places count as OpenCV's `remap` takes them.
    """
    # OpenCV counts pixels from their centres, so both principal points lie half a pixel lower there.
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    distortion = np.array(camera.distortion)
    columns, rows = cv2.initUndistortRectifyMap(
        camera.K - half, distortion, None, K - half, (width, height), cv2.CV_32FC1
    )
    return columns, rows


def _inscribed(camera: PhotoCamera, K: np.ndarray) -> tuple[float, float, float, float]:
    """Left, top, right, bottom at z = 1 of the largest rectangle between the photo's straightened edges."""
    along = np.linspace(0, 1, 33)
    edges = {
        "left": np.stack([0 * along, along * camera.height], 1),
        "right": np.stack([0 * along + camera.width, along * camera.height], 1),
        "top": np.stack([along * camera.width, 0 * along], 1),
        "bottom": np.stack([along * camera.width, 0 * along + camera.height], 1),
    }
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    distortion = np.array(camera.distortion)
    flat = {
        side: cv2.undistortPoints(edge[:, None], K, distortion, None, None, None, criteria)[:, 0]
        for side, edge in edges.items()
    }
    return (
        float(flat["left"][:, 0].max()),
        float(flat["top"][:, 1].max()),
        float(flat["right"][:, 0].min()),
        float(flat["bottom"][:, 1].min()),
    )
