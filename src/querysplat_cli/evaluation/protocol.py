"""The inputs of a method and the targets of its renders, in the two published protocols.

`release` (the authors' evaluation script): inputs are the largest centred square at 512 × 512, renders are made at
256 × 256, and the truth is that square, reduced to 256 × 256 with an antialiased bilinear filter. `text` (paper,
Comparisons): inputs have a shorter side of 256. Renders are made at the method's own resolution, and resized to the
photo's own size. Photos are never enlarged before they are shown.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.runtime.choices import ProtocolName
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.fit import Crop, centred_crop, resized
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import eight_bit
from querysplat_cli.scene.views import Photo
from querysplat_cli.splat.conventions import MID_GREY, RELEASE
from querysplat_cli.splat.render import render


@dataclass(frozen=True)
class Protocol:
    """One of the two protocols."""

    name: ProtocolName

    @property
    def _shorter_side(self) -> int:
        policy = EVALUATION_POLICY
        return policy.release_input_side if self.name == "release" else policy.text_input_side

    def shown(self, photo: Photo) -> Photo:
        """The photo as an input of a method, with the size of the whole photo, whose lens it has."""
        pixels = photo.pixels
        if self.name == "release":
            square = _square(photo)
            pixels = pixels[square.top : square.top + square.height, square.left : square.left + square.width]
        scale = min(1.0, self._shorter_side / min(pixels.shape[:2]))
        height, width = (round(size * scale) for size in pixels.shape[:2])
        if scale < 1:
            pixels = eight_bit(resized(_tensor(pixels), (height, width)))
        focal = photo.focal and photo.focal * scale
        whole = round(photo.height * scale), round(photo.width * scale)
        return replace(photo, pixels=np.ascontiguousarray(pixels), focal=focal, cut_from=whole)

    def shown_camera(self, camera: PhotoCamera, photo: Photo) -> PhotoCamera:
        """The camera of `shown(photo)`, from that of the photo at any size.

        Raises QuerySplatError when the camera is of a picture of another shape.
        """
        if not same_shape((photo.height, photo.width), (camera.height, camera.width)):
            raise QuerySplatError(
                f"{photo.name} is {photo.width} × {photo.height}, its camera {camera.width} × {camera.height}",
                "Give the cameras of these pictures.",
            )
        fitted = rescaled(camera, photo.height, photo.width)
        if self.name == "release":
            square = _square(photo)
            principal = fitted.principal[0] - square.left, fitted.principal[1] - square.top
            fitted = replace(fitted, principal=principal, height=square.height, width=square.width)
        scale = min(1.0, self._shorter_side / min(fitted.height, fitted.width))
        return rescaled(fitted, round(fitted.height * scale), round(fitted.width * scale))

    def truth(self, photo: Photo) -> Float[Tensor, "3 height width"]:
        """The target that a render is compared with, in [0, 1]."""
        if self.name == "text":
            return _tensor(photo.pixels)
        side = EVALUATION_POLICY.release_target_side
        return resized(_tensor(self.shown(photo).pixels), (side, side))

    def picture(
        self, gaussians: Gaussians, camera: PhotoCamera, photo: Photo, own_size: int | None = None
    ) -> Float[Tensor, "3 height width"]:
        """The render that `truth(photo)` is compared with; `camera` is that of `shown(photo)`, in the scene's frame.

        `own_size` is the longer side in pixels at which the method renders, by default that of `shown(photo)`. It is
        for `text` alone.
        """
        if self.name == "text":
            scale = (own_size or max(camera.height, camera.width)) / max(camera.height, camera.width)
            own = rescaled(camera, round(scale * camera.height), round(scale * camera.width))
            return resized(photograph(gaussians, own), (photo.height, photo.width))
        side = EVALUATION_POLICY.release_target_side
        return photograph(gaussians, rescaled(camera, side, side))


def _square(photo: Photo) -> Crop:
    return centred_crop((photo.height, photo.width), (1, 1))


def photograph(gaussians: Gaussians, camera: PhotoCamera) -> Float[Tensor, "3 height width"]:
    """The picture in [0, 1], on mid-grey as in the release, that `camera` takes with its lens.

    For a distorting lens, a larger pinhole render is resampled (bicubic).
    """
    K = camera.K
    if not any(camera.distortion):
        return _render(gaussians, camera.w2c, K, camera.height, camera.width)
    # OpenCV has pixel centres at whole numbers, so its principal point is smaller by half a pixel.
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    pixels = np.stack([x, y], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, K - half, np.array(camera.distortion), None, None, K - half, criteria)
    straight = straight.reshape(camera.height, camera.width, 2)
    border = 3  # the bicubic filter's support beyond the outermost pixel
    corner = np.floor(straight.min((0, 1))).astype(int) - border
    width, height = (np.ceil(straight.max((0, 1))).astype(int) + border + 1 - corner).tolist()
    shifted = K - np.array([[0, 0, corner[0]], [0, 0, corner[1]], [0, 0, 0]])
    wide = _render(gaussians, camera.w2c, shifted, height, width).permute(1, 2, 0).numpy()
    columns, lines = np.moveaxis((straight - corner).astype(np.float32), -1, 0)
    seen = cv2.remap(wide, columns, lines, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(seen).permute(2, 0, 1).clamp(0, 1)


def _render(gaussians: Gaussians, w2c: np.ndarray, K: np.ndarray, height: int, width: int) -> Tensor:
    cameras = Cameras(torch.from_numpy(w2c).float()[None], torch.from_numpy(K).float()[None], height, width)
    with torch.no_grad():
        return rendered_as_release(gaussians, cameras)[0].clamp(0, 1)


def rendered_as_release(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "views 3 height width"]:
    """What the official code sees: over mid-grey, with its limit of α; colours are not clamped."""
    return render(gaussians, cameras, background=torch.full((3,), MID_GREY), settings=RELEASE).colour


def _tensor(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).float() / 255
