"""The furniture of a procedural room. Lengths are in metres; x, y is the place on the floor."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from querysplat_cli.training.palettes import (
    BRICKS,
    FABRICS,
    FLOWERS,
    GREENS,
    STONES,
    WALLS,
    WOODS,
    draw_paint,
    draw_pair,
)
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.solids import Colour, Number, Solid, Vector


def make_shell(chance: np.random.Generator, wide: float, deep: float) -> Iterator[Solid]:
    """Floor, four walls and ceiling as slabs. The camera's side of the room is the longer one."""
    floor = draw_paint(chance, ("planks", WOODS), ("tiles", STONES))
    wall, other = (
        draw_paint(chance, ("brick", BRICKS), ("plaster", WALLS)),
        draw_paint(chance, ("plaster", WALLS), ("brick", BRICKS)),
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


def make_rug(chance: np.random.Generator) -> Iterator[Solid]:
    first, second = draw_pair(chance, FABRICS)
    yield Solid(BOX, (0, -0.1, 0.01), (1.35, 0.95, 0.01), "rug", first, second, chance.uniform(-0.12, 0.12))


def make_shelf(chance: np.random.Generator, x: float, deep: float) -> Iterator[Solid]:
    """A bookcase on the back wall, its boards filled with books and a few things."""
    first, second = draw_pair(chance, WOODS)
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
            BOX, (x + lean, y + 0.02, z + 0.018 + height), (length, 0.11, height), "books", *draw_pair(chance, FABRICS)
        )
        if length < 0.75 * half:
            other = x - math.copysign(half - 0.14, lean)
            yield Solid(BALL, (other, y, z + 0.018 + 0.1), (0.1, 0.1, 0.1), "marble", *draw_pair(chance, STONES))
    z = 0.06 + (boards - 1) * gap + 0.018
    yield Solid(CYLINDER, (x - 0.3, y, z + 0.11), (0.08, 0.08, 0.11), "rug", *draw_pair(chance, FABRICS), grain=0.35)
    yield Solid(BOX, (x + 0.2, y, z + 0.07), (0.2, 0.1, 0.07), "tiles", *draw_pair(chance, FABRICS), 0.2, 0.25)


def make_sofa(chance: np.random.Generator, x: float, deep: float) -> Iterator[Solid]:
    first, second = draw_pair(chance, FABRICS)
    half, y, cloth = 0.85, deep - 0.5, "plain"
    yield Solid(BOX, (x, y, 0.26), (half, 0.42, 0.14), cloth, first, second, grain=0.7)
    yield Solid(BOX, (x, y + 0.33, 0.58), (half, 0.1, 0.26), cloth, first, second, grain=0.7)
    for edge in (-1, 1):
        yield Solid(BOX, (x + edge * half, y, 0.34), (0.1, 0.44, 0.24), cloth, first, second, grain=0.7)
        place = (x + edge * chance.uniform(0.35, 0.6), y + 0.12, 0.55)
        yield Solid(BALL, place, (0.2, 0.1, 0.17), "rug", *draw_pair(chance, FABRICS), chance.uniform(-0.4, 0.4), 0.4)
        for front in (-0.36, 0.36):
            foot = (x + edge * (half - 0.06), y + front, 0.06)
            yield Solid(CYLINDER, foot, (0.03, 0.03, 0.06), "plain", *draw_pair(chance, WOODS))


def make_pictures(chance: np.random.Generator, side: float, wide: float, deep: float) -> Iterator[Solid]:
    """Prints on the back wall above the sofa, and on both side walls."""
    x = side * 0.35
    for _ in range(3):
        w, h = float(chance.uniform(0.24, 0.38)), float(chance.uniform(0.26, 0.42))
        if abs(x) + w > wide - 0.1:
            break
        z = 1.62 + float(chance.uniform(-0.08, 0.12))
        yield Solid(BOX, (x, deep - 0.015, z), (w, 0.015, h), "poster", (0.9, 0.9, 0.9), draw_pair(chance, WOODS)[1])
        x += side * (2 * w + chance.uniform(0.1, 0.2))
    for wall in (-1, 1):
        for y in (deep - 1.3, deep - 2.6, deep - 3.9):
            w, h = float(chance.uniform(0.35, 0.5)), float(chance.uniform(0.3, 0.5))
            centre = (wall * (wide - 0.015), y, 1.55 + float(chance.uniform(-0.1, 0.1)))
            yield Solid(BOX, centre, (0.015, w, h), "poster", (0.9, 0.9, 0.9), draw_pair(chance, WOODS)[1])


def make_table(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    """A table with a bowl, a vase and a pile of books on it."""
    first, second = draw_pair(chance, WOODS)
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
    yield Solid(BALL, on(order[0], 0.05, top + radius), (radius,) * 3, "marble", *draw_pair(chance, STONES))
    z = top
    for _ in range(4):
        h = float(chance.uniform(0.015, 0.03))
        book = (float(chance.uniform(0.12, 0.16)), float(chance.uniform(0.09, 0.11)), h)
        yield Solid(
            BOX,
            on(order[1], -0.05, z + h),
            book,
            "rug",
            *draw_pair(chance, FABRICS),
            turn + chance.uniform(-0.5, 0.5),
            0.35,
        )
        z += 2 * h
    h = float(chance.uniform(0.12, 0.17))
    yield Solid(CYLINDER, on(order[2], 0, top + h), (0.075, 0.075, h), "tiles", *draw_pair(chance, FABRICS), grain=0.2)
    for _ in range(5):
        place = on(
            order[2] + chance.uniform(-0.09, 0.09), chance.uniform(-0.09, 0.09), top + 2 * h + chance.uniform(0, 0.13)
        )
        yield Solid(BALL, place, (0.07, 0.07, 0.06), "leaves", *draw_pair(chance, FLOWERS), grain=0.5)


def make_plant(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    yield Solid(CYLINDER, (x, y, 0.2), (0.22, 0.22, 0.2), "brick", *draw_pair(chance, BRICKS), grain=0.6)
    yield Solid(CYLINDER, (x, y, 0.75), (0.03, 0.03, 0.4), "plain", *draw_pair(chance, WOODS))
    for _ in range(7):
        r = float(chance.uniform(0.15, 0.27))
        place = (x + chance.uniform(-0.22, 0.22), y + chance.uniform(-0.22, 0.2), chance.uniform(0.9, 1.65))
        yield Solid(BALL, place, (r, r, 0.8 * r), "leaves", *draw_pair(chance, GREENS), chance.uniform(0, 3))


def make_lamp(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    first, second = draw_pair(chance, FABRICS)
    yield Solid(CYLINDER, (x, y, 0.02), (0.15, 0.15, 0.02), "plain", *draw_pair(chance, WOODS))
    yield Solid(CYLINDER, (x, y, 0.75), (0.018, 0.018, 0.75), "plain", *draw_pair(chance, WOODS))
    yield Solid(CYLINDER, (x, y, 1.6), (0.2, 0.2, 0.16), "rug", first, second, grain=0.5)


def make_crates(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    z = 0.0
    for half in (0.3, 0.24, 0.16):
        h = half * float(chance.uniform(0.65, 0.85))
        place = (x + chance.uniform(-0.04, 0.04), y + chance.uniform(-0.04, 0.04), z + h)
        paint, first, second = draw_paint(chance, ("planks", WOODS), ("poster", WOODS), ("tiles", FABRICS))
        yield Solid(BOX, place, (half, half, h), paint, first, second, chance.uniform(-0.6, 0.6), 0.6)
        z += 2 * h


def make_statue(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    """A ball on a pedestal."""
    h, r = float(chance.uniform(0.3, 0.45)), float(chance.uniform(0.2, 0.26))
    shape = int(chance.choice([BOX, CYLINDER]))
    yield Solid(shape, (x, y, h), (0.2, 0.2, h), "brick", *draw_pair(chance, BRICKS), chance.uniform(-0.6, 0.6), 0.7)
    yield Solid(BOX, (x, y, 2 * h + 0.025), (0.25, 0.25, 0.025), "marble", *draw_pair(chance, STONES), 0.3)
    paint, first, second = draw_paint(chance, ("marble", STONES), ("tiles", FABRICS))
    yield Solid(BALL, (x, y, 2 * h + 0.05 + r), (r, r, r), paint, first, second, grain=0.6)
