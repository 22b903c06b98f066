"""Made-up rooms and exact photographs of them: the demo's subject, and training data without a download."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training import raycast
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.textures import PAINTS

HEIGHT, WIDTH, FOCAL = 480, 640, 560.0
"""The photographer's camera, in pixels: a horizontal field of view of 59°."""
LAMPS = 8
"""Points that stand for the lamp's area."""

Number = float | int
Vector = tuple[Number, Number, Number]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """A box, ball or cylinder. Metres; z is up; colours are sRGB, 0 to 1.

    `size` is half the extent along each axis, `turn` an angle about the vertical, in radians. `paint` is
    one of `textures.PAINTS`, with two colours and a scale.
    """

    shape: int
    centre: Vector
    size: Vector
    paint: str
    first: Colour
    second: Colour
    turn: Number = 0
    grain: Number = 1
    seed: int = 0
    casts_shadow: bool = True


@dataclass(frozen=True)
class Scene:
    """Solids, the middle of the square lamp under the ceiling, and what a photographer looks at."""

    solids: tuple[Solid, ...]
    lamp: Vector
    focus: Vector


def make_scene(seed: int) -> Scene:
    """A furnished room of about 7 × 6 metres; furniture, its places, patterns and colours depend on the seed."""
    chance = np.random.default_rng(seed)
    side = float(chance.choice([-1, 1]))
    wide, deep = float(chance.uniform(3.1, 3.7)), float(chance.uniform(2.0, 2.4))
    parts = [
        *_room(chance, wide, deep),
        *_rug(chance),
        *_shelf(chance, side * chance.uniform(1.5, 1.8), deep),
        *_sofa(chance, -side * chance.uniform(0.8, 1.1), deep),
        *_pictures(chance, -side, wide, deep),
        *_table(chance, side * chance.uniform(0.0, 0.25), chance.uniform(-0.25, 0.0)),
        *_plant(chance, -side * (wide - 0.75), deep - 0.55),
        *_lamp(chance, side * 0.55, deep - 0.4),
        *_crates(chance, side * chance.uniform(1.6, 1.9), chance.uniform(-0.1, 0.3)),
        *_statue(chance, -side * chance.uniform(1.75, 2.05), chance.uniform(-0.5, -0.2)),
    ]
    numbered = tuple(replace(part, seed=int(chance.integers(2**31))) for part in parts)
    return Scene(numbered, (-side * 0.9, -0.9, 2.65), (0.0, 0.5, 0.75))


def walk(scene: Scene, views: int, seed: int) -> Cameras:
    """Cameras of a person who walks past the furniture in an arc, and keeps looking at it.

    The arc spans at most 70°, and at most 9° between two photos, so that neighbours overlap well. The
    height goes up and down by about 20 cm, and the aim wanders a little.
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
    z = target - eye
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    w2c = np.tile(np.eye(4), (views, 1, 1))
    w2c[:, :3, :3] = np.stack([x, np.cross(z, x), z], 1)
    w2c[:, :3, 3] = -np.einsum("vij,vj->vi", w2c[:, :3, :3], eye)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(views, 1, 1)
    return Cameras(torch.from_numpy(w2c).float(), K, HEIGHT, WIDTH)


def cast(
    scene: Scene, cameras: Cameras, samples: int = 2
) -> tuple[Float[Tensor, "views 3 height width"], Float[Tensor, "views height width"]]:
    """Photographs in [0, 1], sRGB, and depth: camera z in metres through each pixel's middle, 0 for nothing.

    `samples`² rays are averaged in a pixel where surfaces meet.
    """
    solids, lamps = _packed(scene.solids), _lamp_points(scene.lamp)
    opaque = np.flatnonzero([solid.casts_shadow for solid in scene.solids])
    size = len(cameras), cameras.height, cameras.width
    images, depth, face = np.zeros((*size, 3)), np.zeros(size), np.zeros(size[1:], np.int64)
    c2w, K = cameras.to(torch.float64).c2w.numpy(), cameras.K.double().numpy()
    for view in range(len(cameras)):
        focal, principal = (K[view, 0, 0], K[view, 1, 1]), (K[view, 0, 2], K[view, 1, 2])
        raycast.measure_view(solids, c2w[view], focal, principal, depth[view], face)
        raycast.photograph_view(
            solids, opaque, lamps, c2w[view], focal, principal, depth[view], face, images[view], samples
        )
    return torch.from_numpy(images).float().permute(0, 3, 1, 2).contiguous(), torch.from_numpy(depth).float()


def _packed(solids: Sequence[Solid]) -> np.ndarray:
    """The table that `raycast` takes."""
    table = np.zeros((len(solids), raycast.COLUMNS))
    for row, solid in zip(table, solids, strict=True):
        row[raycast.SHAPE], row[raycast.PAINT] = solid.shape, PAINTS.index(solid.paint)
        row[raycast.GRAIN], row[raycast.SEED] = solid.grain, solid.seed
        row[raycast.COS], row[raycast.SIN] = math.cos(solid.turn), math.sin(solid.turn)
        row[raycast.CENTRE], row[raycast.SIZE] = solid.centre, solid.size
        row[raycast.REACH] = np.square(solid.size).sum()
        # Light adds up in linear colour; a power of 2.2 stands for sRGB's curve.
        row[raycast.FIRST], row[raycast.SECOND] = np.power(solid.first, 2.2), np.power(solid.second, 2.2)
    return table


def _lamp_points(middle: Vector) -> np.ndarray:
    """Points [LAMPS, 3] of a level disc; the first half of them is spread over all of it, like the rest."""
    number = np.arange(LAMPS)
    radius, angle = 0.45 * np.sqrt((number % (LAMPS / 2) + 0.5) / LAMPS * 2), number * math.pi * (3 - math.sqrt(5))
    return np.array(middle) + np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], 1)


def _room(chance: np.random.Generator, wide: float, deep: float) -> Iterator[Solid]:
    """Floor, four walls and ceiling as slabs; the room reaches further towards the photographer."""
    floor = _pick(chance, ("planks", WOODS), ("tiles", STONES))
    wall, other = (
        _pick(chance, ("brick", BRICKS), ("plaster", WALLS)),
        _pick(chance, ("plaster", WALLS), ("brick", BRICKS)),
    )
    front, high, t = 4.2, 2.9, 0.1
    middle, half = (deep - front) / 2, (deep + front) / 2
    slabs: Sequence[tuple[tuple[str, Colour, Colour], Vector, Vector]] = (
        (floor, (0, middle, -t), (wide, half, t)),
        (wall, (0, deep + t, high / 2), (wide, t, high / 2)),
        (other, (-wide - t, middle, high / 2), (t, half, high / 2)),
        (other, (wide + t, middle, high / 2), (t, half, high / 2)),
        (other, (0, -front - t, high / 2), (wide, t, high / 2)),
        (("plaster", (0.95, 0.94, 0.91), (0.80, 0.78, 0.75)), (0, middle, high + t), (wide, half, t)),
    )
    for (paint, first, second), centre, size in slabs:
        yield Solid(BOX, centre, size, paint, first, second, casts_shadow=False)


def _rug(chance: np.random.Generator) -> Iterator[Solid]:
    first, second = _two(chance, FABRICS)
    yield Solid(BOX, (0, -0.1, 0.01), (1.35, 0.95, 0.01), "rug", first, second, chance.uniform(-0.12, 0.12))


def _shelf(chance: np.random.Generator, x: float, deep: float) -> Iterator[Solid]:
    """A bookcase on the back wall, its boards filled with books and a few things."""
    first, second = _two(chance, WOODS)
    half, depth, boards, gap = 0.62, 0.16, 5, 0.42
    y, top = deep - depth - 0.01, boards * gap - 0.2
    for edge in (-1, 1):
        yield Solid(BOX, (x + edge * half, y, top / 2), (0.02, depth, top / 2), "planks", first, second, grain=2)
    yield Solid(BOX, (x, deep - 0.015, top / 2), (half, 0.01, top / 2), "planks", first, second, grain=2)
    for board in range(boards):
        z = 0.06 + board * gap
        yield Solid(BOX, (x, y, z), (half, depth, 0.018), "planks", first, second, grain=2)
        if board == boards - 1:
            continue
        length = float(chance.uniform(0.5, 0.95)) * half
        lean = float(chance.choice([-1, 1])) * (half - length - 0.03)
        height = float(chance.uniform(0.13, 0.165))
        yield Solid(
            BOX, (x + lean, y + 0.02, z + 0.018 + height), (length, 0.11, height), "books", *_two(chance, FABRICS)
        )
        if length < 0.75 * half:
            other = x - math.copysign(half - 0.14, lean)
            yield Solid(BALL, (other, y, z + 0.018 + 0.1), (0.1, 0.1, 0.1), "marble", *_two(chance, STONES))
    z = 0.06 + (boards - 1) * gap + 0.018
    yield Solid(CYLINDER, (x - 0.3, y, z + 0.11), (0.08, 0.08, 0.11), "rug", *_two(chance, FABRICS), grain=0.35)
    yield Solid(BOX, (x + 0.2, y, z + 0.07), (0.2, 0.1, 0.07), "tiles", *_two(chance, FABRICS), 0.2, 0.25)


def _sofa(chance: np.random.Generator, x: float, deep: float) -> Iterator[Solid]:
    first, second = _two(chance, FABRICS)
    half, y, cloth = 0.85, deep - 0.5, "plain"
    yield Solid(BOX, (x, y, 0.26), (half, 0.42, 0.14), cloth, first, second, grain=0.7)
    yield Solid(BOX, (x, y + 0.33, 0.58), (half, 0.1, 0.26), cloth, first, second, grain=0.7)
    for edge in (-1, 1):
        yield Solid(BOX, (x + edge * half, y, 0.34), (0.1, 0.44, 0.24), cloth, first, second, grain=0.7)
        place = (x + edge * chance.uniform(0.35, 0.6), y + 0.12, 0.55)
        yield Solid(BALL, place, (0.2, 0.1, 0.17), "rug", *_two(chance, FABRICS), chance.uniform(-0.4, 0.4), 0.4)
        for front in (-0.36, 0.36):
            yield Solid(
                CYLINDER, (x + edge * (half - 0.06), y + front, 0.06), (0.03, 0.03, 0.06), "plain", *_two(chance, WOODS)
            )


def _pictures(chance: np.random.Generator, side: float, wide: float, deep: float) -> Iterator[Solid]:
    """Prints on the back wall above the sofa, and on both side walls."""
    x = side * 0.35
    for _ in range(3):
        w, h = float(chance.uniform(0.24, 0.38)), float(chance.uniform(0.26, 0.42))
        if abs(x) + w > wide - 0.1:
            break
        z = 1.62 + float(chance.uniform(-0.08, 0.12))
        yield Solid(BOX, (x, deep - 0.015, z), (w, 0.015, h), "poster", (0.9, 0.9, 0.9), _one(chance, WOODS))
        x += side * (2 * w + chance.uniform(0.1, 0.2))
    for wall in (-1, 1):
        for y in (deep - 1.3, deep - 2.6, deep - 3.9):
            w, h = float(chance.uniform(0.35, 0.5)), float(chance.uniform(0.3, 0.5))
            centre = (wall * (wide - 0.015), y, 1.55 + float(chance.uniform(-0.1, 0.1)))
            yield Solid(BOX, centre, (0.015, w, h), "poster", (0.9, 0.9, 0.9), _one(chance, WOODS))


def _table(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    """A table with a bowl, a vase and a pile of books on it."""
    first, second = _two(chance, WOODS)
    turn, top = float(chance.uniform(-0.35, 0.35)), float(chance.uniform(0.46, 0.6))
    wide, deep = float(chance.uniform(0.55, 0.7)), float(chance.uniform(0.32, 0.4))

    def on(u: Number, v: Number, z: Number) -> Vector:
        return x + math.cos(turn) * u - math.sin(turn) * v, y + math.sin(turn) * u + math.cos(turn) * v, z

    yield Solid(BOX, on(0, 0, top - 0.025), (wide, deep, 0.025), "planks", first, second, turn, 2)
    for u in (-wide + 0.06, wide - 0.06):
        for v in (-deep + 0.06, deep - 0.06):
            yield Solid(BOX, on(u, v, (top - 0.05) / 2), (0.03, 0.03, (top - 0.05) / 2), "plain", first, second, turn)
    order = chance.permutation([-0.6, 0.0, 0.6]) * wide
    radius = float(chance.uniform(0.11, 0.15))
    yield Solid(BALL, on(order[0], 0.05, top + radius), (radius,) * 3, "marble", *_two(chance, STONES))
    z = top
    for _ in range(4):
        h = float(chance.uniform(0.015, 0.03))
        book = (float(chance.uniform(0.12, 0.16)), float(chance.uniform(0.09, 0.11)), h)
        yield Solid(
            BOX, on(order[1], -0.05, z + h), book, "rug", *_two(chance, FABRICS), turn + chance.uniform(-0.5, 0.5), 0.35
        )
        z += 2 * h
    h = float(chance.uniform(0.12, 0.17))
    yield Solid(CYLINDER, on(order[2], 0, top + h), (0.075, 0.075, h), "tiles", *_two(chance, FABRICS), grain=0.2)
    for _ in range(5):
        place = on(
            order[2] + chance.uniform(-0.09, 0.09), chance.uniform(-0.09, 0.09), top + 2 * h + chance.uniform(0, 0.13)
        )
        yield Solid(BALL, place, (0.07, 0.07, 0.06), "leaves", *_two(chance, FLOWERS), grain=0.5)


def _plant(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    yield Solid(CYLINDER, (x, y, 0.2), (0.22, 0.22, 0.2), "brick", *_two(chance, BRICKS), grain=0.6)
    yield Solid(CYLINDER, (x, y, 0.75), (0.03, 0.03, 0.4), "plain", *_two(chance, WOODS))
    for _ in range(7):
        r = float(chance.uniform(0.15, 0.27))
        place = (x + chance.uniform(-0.22, 0.22), y + chance.uniform(-0.22, 0.2), chance.uniform(0.9, 1.65))
        yield Solid(BALL, place, (r, r, 0.8 * r), "leaves", *_two(chance, GREENS), chance.uniform(0, 3))


def _lamp(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    first, second = _two(chance, FABRICS)
    yield Solid(CYLINDER, (x, y, 0.02), (0.15, 0.15, 0.02), "plain", *_two(chance, WOODS))
    yield Solid(CYLINDER, (x, y, 0.75), (0.018, 0.018, 0.75), "plain", *_two(chance, WOODS))
    yield Solid(CYLINDER, (x, y, 1.6), (0.2, 0.2, 0.16), "rug", first, second, grain=0.5)


def _crates(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    z = 0.0
    for half in (0.3, 0.24, 0.16):
        h = half * float(chance.uniform(0.65, 0.85))
        place = (x + chance.uniform(-0.04, 0.04), y + chance.uniform(-0.04, 0.04), z + h)
        paint, first, second = _pick(chance, ("planks", WOODS), ("poster", WOODS), ("tiles", FABRICS))
        yield Solid(BOX, place, (half, half, h), paint, first, second, chance.uniform(-0.6, 0.6), 0.6)
        z += 2 * h


def _statue(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    """A ball on a pedestal."""
    h, r = float(chance.uniform(0.3, 0.45)), float(chance.uniform(0.2, 0.26))
    shape = int(chance.choice([BOX, CYLINDER]))
    yield Solid(shape, (x, y, h), (0.2, 0.2, h), "brick", *_two(chance, BRICKS), chance.uniform(-0.6, 0.6), 0.7)
    yield Solid(BOX, (x, y, 2 * h + 0.025), (0.25, 0.25, 0.025), "marble", *_two(chance, STONES), 0.3)
    paint, first, second = _pick(chance, ("marble", STONES), ("tiles", FABRICS))
    yield Solid(BALL, (x, y, 2 * h + 0.05 + r), (r, r, r), paint, first, second, grain=0.6)


Pairs = tuple[tuple[Colour, Colour], ...]
WOODS: Pairs = (
    ((0.78, 0.58, 0.37), (0.50, 0.32, 0.18)),
    ((0.60, 0.41, 0.26), (0.36, 0.22, 0.13)),
    ((0.86, 0.74, 0.55), (0.62, 0.47, 0.30)),
    ((0.55, 0.47, 0.40), (0.33, 0.27, 0.23)),
)
STONES: Pairs = (
    ((0.88, 0.86, 0.82), (0.36, 0.40, 0.44)),
    ((0.80, 0.62, 0.50), (0.92, 0.86, 0.76)),
    ((0.42, 0.55, 0.52), (0.85, 0.88, 0.80)),
    ((0.82, 0.78, 0.70), (0.55, 0.33, 0.25)),
)
BRICKS: Pairs = (
    ((0.68, 0.36, 0.26), (0.80, 0.55, 0.40)),
    ((0.76, 0.70, 0.62), (0.60, 0.52, 0.44)),
    ((0.55, 0.33, 0.30), (0.70, 0.48, 0.38)),
)
WALLS: Pairs = (
    ((0.90, 0.86, 0.76), (0.72, 0.66, 0.55)),
    ((0.70, 0.80, 0.80), (0.50, 0.62, 0.66)),
    ((0.82, 0.72, 0.68), (0.66, 0.54, 0.50)),
    ((0.74, 0.80, 0.66), (0.56, 0.62, 0.48)),
)
FABRICS: Pairs = (
    ((0.70, 0.22, 0.20), (0.92, 0.82, 0.62)),
    ((0.16, 0.34, 0.52), (0.80, 0.82, 0.78)),
    ((0.18, 0.45, 0.42), (0.88, 0.70, 0.38)),
    ((0.82, 0.56, 0.18), (0.35, 0.22, 0.26)),
    ((0.44, 0.30, 0.50), (0.86, 0.76, 0.78)),
)
GREENS: Pairs = (
    ((0.18, 0.36, 0.14), (0.55, 0.70, 0.30)),
    ((0.14, 0.32, 0.20), (0.42, 0.62, 0.38)),
    ((0.30, 0.42, 0.16), (0.70, 0.74, 0.36)),
)
FLOWERS: Pairs = (
    ((0.75, 0.20, 0.28), (0.98, 0.78, 0.40)),
    ((0.90, 0.70, 0.20), (0.98, 0.92, 0.72)),
    ((0.55, 0.30, 0.62), (0.92, 0.80, 0.94)),
    ((0.26, 0.45, 0.18), (0.60, 0.74, 0.34)),
)


def _two(chance: np.random.Generator, pairs: Pairs) -> tuple[Colour, Colour]:
    return pairs[int(chance.integers(len(pairs)))]


def _one(chance: np.random.Generator, pairs: Pairs) -> Colour:
    return _two(chance, pairs)[1]


def _pick(chance: np.random.Generator, *choices: tuple[str, Pairs]) -> tuple[str, Colour, Colour]:
    paint, pairs = choices[int(chance.integers(len(choices)))]
    return paint, *_two(chance, pairs)
