"""Photos of wide lenses, resampled to pinhole views: fisheye photos (Kannala-Brandt), and panoramas of 360°."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError

WIDEST = np.radians(60.0)
"""Angle from the optical axis up to which a fisheye photo is used. A pinhole view stretches what lies farther out."""
MOST = 1000.0
"""Largest number of a view, or of what lies over a photo, in widths of the photo."""
LARGEST_VIEW = 5.0
"""Longer side of the largest view, in widths of its photo."""
FACE_FIELD = 100.0
"""Degrees that a view of a panorama is wide. With 90, six around would leave gaps to the views up and down."""
FACES = (*((float(yaw), 0.0) for yaw in range(0, 360, 60)), (0.0, 90.0), (0.0, -90.0))
"""Degrees (to the right, up) of the optical axes of the views of a panorama: six around that overlap, up and down."""


@dataclass(frozen=True)
class PinholeView:
    """How a pinhole view is taken out of a wide photo, whatever size the photo is read at.

    Lengths are in widths of the photo, so that they hold at any size.

    size: (height, width) of the view.
    focal, principal: (fx, fy) and (cx, cy) of the view.
    fisheye: fx, fy, cx, cy of the photo's lens and OpenCV's fisheye coefficients k1 to k4; None for a panorama.
    rotation: rows of the rotation [3, 3] from the view's axes to the photo's. A panorama's are x right, y down, and z
        forward at its middle column.
    """

    size: tuple[float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    fisheye: tuple[float, ...] | None = None

    def fault(self) -> str:
        """Why there is no such view, or ""."""
        numbers = (*self.size, *self.focal, *self.principal, *self.rotation, *(self.fisheye or ()))
        whole = len(self.rotation) == 9 and (self.fisheye is None or len(self.fisheye) == 8)
        if not whole or not np.isfinite(numbers).all() or np.abs(numbers).max() > MOST:
            return "its view has other numbers than those of a lens"
        if min(*self.size, *self.focal) < 1 / MOST or max(self.size) > LARGEST_VIEW:
            return f"its view is {self.size[1]:g} × {self.size[0]:g} widths of the photo"
        return ""

    @property
    def photo_aspect(self) -> float:
        """Height of the photo in its widths."""
        return self.size[0] / self.size[1] if self.fisheye else 0.5

    def photo_width(self, longer_side: int) -> int:
        """Of a photo whose longer side is given, in pixels."""
        return round(longer_side / max(1.0, self.photo_aspect))

    def photo_side(self, view_side: int) -> int:
        """The longer side of a photo whose view has this longer side, in pixels."""
        return round(view_side / max(self.size) * max(1.0, self.photo_aspect))

    def shape(self, photo_width: int) -> tuple[int, int]:
        """(height, width) in pixels of the view of a photo that is so wide."""
        return round(self.size[0] * photo_width), round(self.size[1] * photo_width)

    def picture(self, photo: np.ndarray) -> np.ndarray:
        """The view of a photo [height, width, …], with pixels of the photo's type."""
        x, y = self._places(photo.shape[0], photo.shape[1])
        if self.fisheye is None:  # a panorama goes on at its other side
            photo = np.concatenate([photo, photo[:, :2]], axis=1)
        return cv2.remap(photo, x - 0.5, y - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _places(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Where in the photo each pixel of the view comes from: x and y, float32, pixel centres at +0.5."""
        rows, columns = self.shape(width)
        u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        rays = np.stack([
            (u * self.size[1] - self.principal[0]) / self.focal[0],
            (v * self.size[0] - self.principal[1]) / self.focal[1],
            np.ones_like(u),
        ])  # fmt: skip
        x, y, z = np.tensordot(np.array(self.rotation).reshape(3, 3), rays, 1)
        if self.fisheye:
            fx, fy, cx, cy, *coefficients = self.fisheye
            radius = np.hypot(x, y)
            bent = bend(np.arctan2(radius, z), coefficients) / np.maximum(radius, 1e-12)
            places = (fx * bent * x + cx) * width, (fy * bent * y + cy) * width
        else:
            turn, lift = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
            # The first column is drawn again behind the last one.
            places = ((turn / (2 * np.pi) + 0.5) % 1.0) * width, (0.5 - lift / np.pi) * height
        return places[0].astype(np.float32), places[1].astype(np.float32)


def bend(angle: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """OpenCV's fisheye model: the distance from the principal point, in focal lengths, at an angle from the axis."""
    square = angle**2
    k1, k2, k3, k4 = coefficients
    return np.asarray(angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))))


def panorama_views() -> list[PinholeView]:
    """The views that a panorama of 2 : 1 becomes."""
    # As many pixels a degree, in the middle, as the panorama has.
    side = math.tan(math.radians(FACE_FIELD / 2)) / math.pi
    focal = 1 / (2 * np.pi)
    return [
        PinholeView((side, side), (focal, focal), (side / 2, side / 2), tuple(_turned(yaw, lift).ravel().tolist()))
        for yaw, lift in FACES
    ]


def fisheye_view(lens: tuple[float, ...], coefficients: tuple[float, ...], height: int, width: int) -> PinholeView:
    """The largest pinhole view of a fisheye photo, of the photo's shape, with its scale in the middle.

    `lens` is (fx, fy, cx, cy) in pixels. The view ends where the photo ends, and `WIDEST` from the axis. Raises
    QuerySplatError when the lens folds the picture over itself.
    """
    fx, fy, cx, cy = lens
    angles = np.linspace(0, WIDEST, 200)
    if (np.diff(bend(angles, list(coefficients))) <= 0).any():
        raise QuerySplatError(
            f"the fisheye coefficients {', '.join(f'{k:g}' for k in coefficients)} fold the picture over itself",
            "Give the cameras with the lens that took the photos.",
        )
    along = np.linspace(-1, 1, 65)
    one = np.ones_like(along)
    border = np.stack([np.concatenate([along, along, -one, one]), np.concatenate([-one, one, along, along])])
    half = np.array([[width / fx / 2], [height / fy / 2]])

    def fits(scale: float) -> bool:
        x, y = border * half * scale
        radius = np.hypot(x, y)
        bent = bend(np.arctan(radius), list(coefficients)) / radius
        u, v = fx * bent * x + cx, fy * bent * y + cy
        inside = (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
        return bool(inside.all() and np.arctan(radius).max() <= WIDEST)

    low, high = 0.0, 4.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    if low < 0.05:
        raise QuerySplatError("a fisheye lens whose middle lies outside its picture", "Check the given cameras.")
    size = (height * low / width, low)
    return PinholeView(
        size,
        (fx / width, fy / width),
        (size[1] / 2, size[0] / 2),
        fisheye=(fx / width, fy / width, cx / width, cy / width, *coefficients),
    )


def _turned(yaw: float, lift: float) -> np.ndarray:
    """The rotation from a view that looks so many degrees to the right and up to the panorama's axes."""
    a, b = np.radians([yaw, lift])
    around = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    up = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return around @ up
