"""More procedural scenes: things on open ground, and cameras that stand anywhere, for training."""

import math
from collections.abc import Iterator

import numpy as np
import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training.procedural import (
    BRICKS,
    FABRICS,
    FLOWERS,
    GREENS,
    STONES,
    WALLS,
    WOODS,
    Colour,
    Scene,
    Solid,
)
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER

PALETTES = (*WOODS, *STONES, *BRICKS, *WALLS, *FABRICS, *GREENS, *FLOWERS)
SURFACES = ("plaster", "brick", "planks", "tiles", "poster", "rug", "marble", "leaves", "plain")
CLEARANCE = 0.25
"""Metres that a camera keeps from every surface."""
TRIES = 200


def make_outdoors(seed: int) -> Scene:
    """Six to twenty solids on the ground, some of them thin poles, before facades, open sky or darkness."""
    chance = np.random.default_rng([seed, 1])
    things = [*_ground(chance), *_pile(chance), *_poles(chance), *_background(chance)]
    lamp = (float(chance.uniform(-3, 3)), float(chance.uniform(-3, 1)), float(chance.uniform(1.8, 3.5)))
    return Scene(tuple(things), lamp, (0.0, 0.0, float(chance.uniform(0.2, 0.6))))


def wander(scene: Scene, views: int, seed: int, height: int, width: int) -> Cameras:
    """Cameras of a person who goes around something, past it or towards it, held upright or not.

    The field of view, the distance and the step are drawn; a step turns by 2° to 12° about the focus. No camera
    is nearer than `CLEARANCE` to a solid; raises ValueError where no such walk is found.
    """
    chance = np.random.default_rng([seed, views, 2])
    focal = float(chance.uniform(0.75, 1.35)) * max(height, width)
    for _ in range(TRIES):
        eye, target = _path(chance, scene, views)
        if min(_distance(solid, eye).min() for solid in scene.solids) > CLEARANCE:
            break
    else:
        raise ValueError(f"no free walk in scene {seed}")
    z = target - eye
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    roll = chance.normal(0, 0.04, views)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    x, y = (
        np.cos(roll)[:, None] * x + np.sin(roll)[:, None] * y,
        np.cos(roll)[:, None] * y - np.sin(roll)[:, None] * x,
    )
    w2c = np.tile(np.eye(4), (views, 1, 1))
    w2c[:, :3, :3] = np.stack([x, y, z], 1)
    w2c[:, :3, 3] = -np.einsum("vij,vj->vi", w2c[:, :3, :3], eye)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).repeat(views, 1, 1)
    return Cameras(torch.from_numpy(w2c).float(), K, height, width)


def _path(chance: np.random.Generator, scene: Scene, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Eyes and what they look at [views, 3]."""
    focus = np.array(scene.focus) + chance.uniform(-1, 1, 3) * (0.8, 0.4, 0.3)
    step = math.radians(float(chance.uniform(2, 12)))
    steps = np.arange(views) - (views - 1) / 2 + chance.uniform(-0.2, 0.2, views)
    angle = float(chance.normal(0, 0.5)) + step * steps
    radius = float(chance.uniform(0.9, 3.2)) * (1 + float(chance.uniform(-0.06, 0.06)) * steps)
    high = float(chance.uniform(0.2, 1.5)) + chance.normal(0, 0.12, views) + float(chance.normal(0, 0.06)) * steps
    eye = np.stack([focus[0] + radius * np.sin(angle), focus[1] - radius * np.cos(angle), np.maximum(high, 0.15)], 1)
    if chance.random() < 0.3:
        # Past it rather than around it: all cameras look the same way, as those of forward-facing sets do.
        ahead = focus - eye.mean(0)
        return eye, eye + ahead + chance.normal(0, 0.04, (views, 3)) * np.linalg.norm(ahead)
    return eye, focus + chance.normal(0, 0.07, (views, 3)) * radius[:, None]


def _distance(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Metres from points [n, 3] to a solid, at most; negative inside. Exact for boxes' faces, near enough elsewhere."""
    moved = points - np.array(solid.centre)
    c, s = math.cos(solid.turn), math.sin(solid.turn)
    local = np.stack([c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0], moved[:, 2]], 1)
    size = np.array(solid.size, dtype=float)
    if solid.shape == BALL:
        return (np.linalg.norm(local / size, axis=1) - 1) * size.min()
    if solid.shape == CYLINDER:
        side = (np.linalg.norm(local[:, :2] / size[:2], axis=1) - 1) * size[:2].min()
        return np.maximum(side, np.abs(local[:, 2]) - size[2])
    return (np.abs(local) - size).max(1)


def _painted(chance: np.random.Generator, *paints: str) -> tuple[str, Colour, Colour]:
    first, second = PALETTES[int(chance.integers(len(PALETTES)))]
    light = float(chance.uniform(0.45, 1.0))
    tinted = [tuple(float(np.clip(light * part, 0, 1)) for part in colour) for colour in (first, second)]
    a, b = ((colour[0], colour[1], colour[2]) for colour in tinted)
    return str(chance.choice(paints)), a, b


def _seed(chance: np.random.Generator) -> int:
    return int(chance.integers(2**31))


def _ground(chance: np.random.Generator) -> Iterator[Solid]:
    reach = float(chance.choice([1.5, 4.0, 15.0]))
    look = _painted(chance, "plaster", "tiles", "planks", "rug", "marble", "leaves", "plain")
    grain = float(chance.uniform(0.5, 2.0))
    yield Solid(BOX, (0, 0, -0.1), (reach, reach, 0.1), *look, grain=grain, seed=_seed(chance), casts_shadow=False)


def _pile(chance: np.random.Generator) -> Iterator[Solid]:
    for _ in range(int(chance.integers(6, 20))):
        far, angle = 1.1 * math.sqrt(chance.random()), float(chance.uniform(0, 2 * math.pi))
        w, d, h = np.exp(chance.uniform(math.log(0.05), math.log(0.4), 3))
        shape = int(chance.choice([BOX, BALL, CYLINDER]))
        w, d = (w, w) if shape == CYLINDER else (w, d)
        raised = float(chance.uniform(0, 0.6)) if chance.random() < 0.25 else 0.0
        place = (far * math.cos(angle), far * math.sin(angle), float(h) + raised)
        grain, turn = float(np.exp(chance.uniform(-1.6, 0.5))), float(chance.uniform(0, 3.1))
        size = (float(w), float(d), float(h))
        yield Solid(shape, place, size, *_painted(chance, *SURFACES), turn=turn, grain=grain, seed=_seed(chance))


def _poles(chance: np.random.Generator) -> Iterator[Solid]:
    for _ in range(int(chance.integers(0, 7))):
        x, y = chance.uniform(-1.2, 1.2, 2)
        thin, high = float(chance.uniform(0.006, 0.03)), float(chance.uniform(0.3, 1.1))
        look = _painted(chance, "plain", "planks", "marble")
        yield Solid(CYLINDER, (float(x), float(y), high), (thin, thin, high), *look, seed=_seed(chance))


def _background(chance: np.random.Generator) -> Iterator[Solid]:
    """Facades from two to twenty metres away, and a sky, which may be missing: what no ray hits is black."""
    if chance.random() < 0.75:
        away = float(np.exp(chance.uniform(math.log(2.0), math.log(18.0))))
        for _ in range(int(chance.integers(1, 6))):
            wide, high = (float(value) for value in away * chance.uniform(0.15, 0.9, 2))
            place = (float(away * chance.uniform(-1.2, 1.2)), away + float(chance.uniform(0, 0.5)) * away, high)
            look = _painted(chance, "brick", "plaster", "planks", "tiles", "leaves")
            grain = float(chance.uniform(0.3, 1.0)) * max(1.0, away / 4)
            yield Solid(BOX, place, (wide, 0.3, high), *look, turn=float(chance.normal(0, 0.3)), grain=grain)
    if chance.random() < 0.85:
        first, second = (
            ((0.62, 0.74, 0.92), (0.90, 0.93, 0.97)) if chance.random() < 0.7 else _painted(chance, "plain")[1:]
        )
        yield Solid(BOX, (0, 45, 10), (90, 0.5, 60), "plain", first, second, grain=40.0, casts_shadow=False)
