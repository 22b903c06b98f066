"""A ray-cast room of textured planes, photographed from known places."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo

HEIGHT, WIDTH, FOCAL = 240, 320, 304.0


@dataclass(frozen=True)
class Plane:
    """Points corner + u·across + v·down with u, v in [0, 1], coloured by `texture`."""

    corner: tuple[float, float, float]
    across: tuple[float, float, float]
    down: tuple[float, float, float]
    texture: np.ndarray


def texture(seed: int, size: int = 512) -> np.ndarray:
    """Noise of all scales, in colour."""
    generator = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells in (8, 16, 32, 64, 128):
        noise = generator.random((cells, cells, 3), np.float32) - 0.5
        total += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) / np.log2(cells)
    return np.clip(255 * (0.5 + 1.6 * total), 0, 255).astype(np.uint8)


def room(seed: int = 0) -> list[Plane]:
    """A back wall at z = 6, a floor, and two boards in front of them."""
    return [
        Plane((-6, -4, 6), (12, 0, 0), (0, 8, 0), texture(seed, 1024)),
        Plane((-6, 1.6, 1.5), (12, 0, 0), (0, 0, 5), texture(seed + 1, 1024)),
        Plane((-1.9, -0.9, 4.6), (1.4, 0, -0.7), (0, 1.8, 0), texture(seed + 2)),
        Plane((0.5, -0.7, 3.4), (1.2, 0, 0.8), (0, 1.7, 0.2), texture(seed + 3)),
    ]


def wall(seed: int = 0) -> list[Plane]:
    """The back wall alone."""
    return room(seed)[:1]


def camera(
    centre: Sequence[float],
    look_at: Sequence[float] = (0, 0, 5),
    roll: float = 0.0,
    *,
    size: tuple[int, int] = (HEIGHT, WIDTH),
    focal: float = FOCAL,
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> PhotoCamera:
    """A camera at `centre` that looks at a point, its y axis downwards but for `roll` radians."""
    z = np.subtract(look_at, centre).astype(float)
    z /= np.linalg.norm(z)
    x = np.cross([np.sin(roll), np.cos(roll), 0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    w2c[:3, 3] = -rotation @ centre
    height, width = size
    return PhotoCamera(w2c, (focal, focal), (width / 2, height / 2), distortion, height, width)


def arc(count: int, **options: object) -> list[PhotoCamera]:
    """Cameras on an arc in front of the room, each at another height."""
    places = [(1.6 * np.sin(a), 0.25 * np.sin(3 * a), 0.4 - 0.6 * np.cos(a)) for a in np.linspace(-1, 1, count)]
    return [camera(place, roll=0.05 * i, **options) for i, place in enumerate(places)]  # type: ignore[arg-type]


def photograph(scene: Sequence[Plane], photo_camera: PhotoCamera, name: str, focal: float | None = None) -> Photo:
    """The photo that `lens` takes, two samples along each side of a pixel; `focal` is its EXIF entry."""
    rays = _rays(photo_camera, samples=2)
    rotation, centre = photo_camera.w2c[:3, :3], -photo_camera.w2c[:3, :3].T @ photo_camera.w2c[:3, 3]
    directions = rays @ rotation
    nearest = np.full(rays.shape[:2], np.inf)
    picture = np.zeros((*rays.shape[:2], 3), np.float32)
    for plane in scene:
        across, down = np.array(plane.across, float), np.array(plane.down, float)
        normal = np.cross(across, down)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (np.subtract(plane.corner, centre) @ normal) / (directions @ normal)
        offset = centre + directions * distance[..., None] - plane.corner
        u, v = offset @ across / (across @ across), offset @ down / (down @ down)
        hit = (distance > 0.05) & (distance < nearest) & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        nearest[hit] = distance[hit]
        size = plane.texture.shape[0]
        at = [np.where(hit, w, 0).astype(np.float32) * size - 0.5 for w in (u, v)]
        picture[hit] = cv2.remap(plane.texture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[hit]
    pixels = cv2.resize(picture, (photo_camera.width, photo_camera.height), interpolation=cv2.INTER_AREA)
    return Photo(name, Path(name), np.round(pixels).astype(np.uint8), focal)


def photographs(scene: Sequence[Plane], cameras: Sequence[PhotoCamera], prefix: str = "") -> list[Photo]:
    return [photograph(scene, each, f"{prefix}{i}.png") for i, each in enumerate(cameras)]


def _rays(photo_camera: PhotoCamera, samples: int) -> np.ndarray:
    """Camera rays [rows, columns, 3] at z = 1, by fixed-point inversion of the lens distortion."""
    v, u = np.mgrid[: photo_camera.height * samples, : photo_camera.width * samples]
    distorted = np.stack(
        [
            ((u + 0.5) / samples - photo_camera.principal[0]) / photo_camera.focal[0],
            ((v + 0.5) / samples - photo_camera.principal[1]) / photo_camera.focal[1],
        ],
        -1,
    )
    k1, k2, p1, p2 = photo_camera.distortion
    flat = distorted.copy()
    for _ in range(30 if any(photo_camera.distortion) else 0):
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        shift = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)
        flat = (distorted - shift) / (1 + k1 * r2 + k2 * r2**2)[..., None]
    return np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1)
