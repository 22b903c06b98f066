"""Cameras in a procedural scene, and exact photographs of it."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training import raycast, shading
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.solids import Scene, Solid, Vector, distance_to
from querysplat_cli.training.textures import PAINTS

HEIGHT, WIDTH, FOCAL = 480, 640, 560.0
"""Image size and focal length of `walk`, in pixels: a horizontal field of view of 59°."""
LAMPS = 8
"""Points that stand for the lamp's area."""
LAMP_RADIUS = 0.45
"""In metres."""


def walk(scene: Scene, views: int, seed: int) -> Cameras:
    """Cameras on an arc in front of the scene's focus, all aimed at it; HEIGHT × WIDTH pixels.

    The arc spans at most 70°, and at most 9° from one camera to the next, so that neighbours overlap well. The
    height goes up and down by about 20 cm, and the aim is off by a few centimetres.
    """
    chance = np.random.default_rng([seed, views])
    reach = min(math.radians(70), math.radians(9) * max(views - 1, 1)) / 2
    angle = np.linspace(-reach, reach, views) if views > 1 else np.zeros(1)
    angle = angle + chance.uniform(-0.012, 0.012, views)
    phase = chance.uniform(0, 2 * math.pi)
    radius = 3.15 + 0.2 * np.sin(2.1 * angle + phase) + chance.uniform(-0.05, 0.05, views)
    height = 1.45 + 0.2 * np.sin(5 * angle + phase) + chance.uniform(-0.04, 0.04, views)
    focus = np.array(scene.focus)
    eye = np.stack([focus[0] + radius * np.sin(angle), focus[1] - radius * np.cos(angle), height], 1)
    target = focus + chance.uniform(-1, 1, (views, 3)) * (0.12, 0.05, 0.08)
    return aimed(eye, target, FOCAL, HEIGHT, WIDTH)


def wander(scene: Scene, views: int, seed: int, height: int, width: int) -> Cameras:
    """Cameras on a path around something, past it or towards it, held upright but for a slight roll.

    The field of view, the distance and the step are drawn; a step turns by 2° to 12° about the focus. No camera
    is nearer to a solid than the policy's `clearance`. Raises ValueError where no such path is found.
    """
    chance = np.random.default_rng([seed, views, 2])
    focal = float(chance.uniform(0.75, 1.35)) * max(height, width)
    for _ in range(TRAINING_POLICY.path_tries):
        eye, target = _draw_path(chance, scene, views)
        if min(distance_to(solid, eye).min() for solid in scene.solids) > scene.reach * TRAINING_POLICY.clearance:
            break
    else:
        raise ValueError(f"no free path in scene {seed}")
    return aimed(eye, target, focal, height, width, roll=chance.normal(0, 0.04, views))


def cast(
    scene: Scene, cameras: Cameras, samples: int = 2
) -> tuple[Float[Tensor, "views 3 height width"], Float[Tensor, "views height width"]]:
    """Photographs in [0, 1], sRGB, and depth: camera z in metres at each pixel's centre, 0 where no surface is.

    A pixel where surfaces meet is the mean of `samples`² rays.
    """
    solids = packed(scene.solids)
    opaque = np.flatnonzero([solid.casts_shadow for solid in scene.solids])
    light = opaque, _lamp_points(scene.lamp), np.array([*scene.lamp, LAMP_RADIUS], dtype=float)
    size = len(cameras), cameras.height, cameras.width
    images, depth, face = np.zeros((*size, 3)), np.zeros(size), np.zeros(size[1:], np.int64)
    c2w, K = cameras.to(torch.float64).c2w.numpy(), cameras.K.double().numpy()
    for view in range(len(cameras)):
        camera = c2w[view], K[view, [0, 1, 0, 1], [0, 1, 2, 2]]
        seen = depth[view], face
        raycast.measure_view(solids, camera, *seen)
        shading.photograph_view(solids, light, camera, seen, images[view], samples)
    return torch.from_numpy(images).float().permute(0, 3, 1, 2).contiguous(), torch.from_numpy(depth).float()


def _draw_path(chance: np.random.Generator, scene: Scene, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Camera centres and the points that the cameras are aimed at [views, 3]."""
    focus = np.array(scene.focus) + scene.reach * chance.uniform(-1, 1, 3) * (0.8, 0.4, 0.3)
    step = math.radians(float(chance.uniform(2, 12)))
    steps = np.arange(views) - (views - 1) / 2 + chance.uniform(-0.2, 0.2, views)
    angle = float(chance.normal(0, 0.5)) + step * steps
    radius = scene.reach * float(chance.uniform(0.9, 3.2)) * (1 + float(chance.uniform(-0.06, 0.06)) * steps)
    high = float(chance.uniform(0.2, 1.5)) + chance.normal(0, 0.12, views) + float(chance.normal(0, 0.06)) * steps
    high = scene.reach * np.maximum(high, 0.15)
    eye = np.stack([focus[0] + radius * np.sin(angle), focus[1] - radius * np.cos(angle), high], 1)
    if chance.random() < 0.3:
        # Past the focus rather than around it: all cameras face the same way, as in forward-facing sets.
        ahead = focus - eye.mean(0)
        return eye, eye + ahead + chance.normal(0, 0.04, (views, 3)) * np.linalg.norm(ahead)
    return eye, focus + chance.normal(0, 0.07, (views, 3)) * radius[:, None]


def aimed(
    eye: np.ndarray, target: np.ndarray, focal: float, height: int, width: int, roll: np.ndarray | None = None
) -> Cameras:
    """Cameras at `eye` towards `target` [views, 3], world z up in the image, turned by `roll` [views] radians."""
    z = target - eye
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    if roll is not None:
        cosine, sine = np.cos(roll)[:, None], np.sin(roll)[:, None]
        x, y = cosine * x + sine * y, cosine * y - sine * x
    w2c = np.tile(np.eye(4), (len(eye), 1, 1))
    w2c[:, :3, :3] = np.stack([x, y, z], 1)
    w2c[:, :3, 3] = -np.einsum("vij,vj->vi", w2c[:, :3, :3], eye)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).repeat(len(eye), 1, 1)
    return Cameras(torch.from_numpy(w2c).float(), K, height, width)


def packed(solids: Sequence[Solid]) -> np.ndarray:
    """The table of numbers that `raycast` takes, a row for each solid."""
    table = np.zeros((len(solids), raycast.TABLE_COLUMNS))
    for row, solid in zip(table, solids, strict=True):
        row[raycast.KIND], row[raycast.PAINT] = solid.shape, PAINTS.index(solid.paint)
        row[raycast.GRAIN], row[raycast.SEED] = solid.grain, solid.seed
        row[raycast.COS], row[raycast.SIN] = math.cos(solid.turn), math.sin(solid.turn)
        row[raycast.CENTRE], row[raycast.SIZE] = solid.centre, solid.size
        row[raycast.GLOSS] = solid.gloss
        row[raycast.BOUND] = np.square(solid.size).sum()
        # Light adds up in linear colour; a power of 2.2 stands for sRGB's curve.
        row[raycast.FIRST], row[raycast.SECOND] = np.power(solid.first, 2.2), np.power(solid.second, 2.2)
    return table


def _lamp_points(middle: Vector) -> np.ndarray:
    """Points [LAMPS, 3] of a level disc. The first half of them, and the second half, each cover the whole disc."""
    number = np.arange(LAMPS)
    radius, angle = (
        LAMP_RADIUS * np.sqrt((number % (LAMPS / 2) + 0.5) / LAMPS * 2),
        number * math.pi * (3 - math.sqrt(5)),
    )
    return np.array(middle) + np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], 1)
