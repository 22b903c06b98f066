"""Procedural still lifes, for training: small things on a table, in a corner or in front of nothing."""

import math
from collections.abc import Iterator

import numpy as np

from querysplat_cli.training.palettes import STONES, WALLS, WOODS, draw_paint, draw_pair
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.solids import Scene, Solid
from querysplat_cli.training.surfaces import drawn_look, drawn_seed

TOP, LEGS = 0.0, 0.75
"""Heights in metres: of the table's top, above which cameras stand, and of its legs."""


def make_tabletop(seed: int) -> Scene:
    """Eight to thirty small things on a table, some of them stacked, some thin; mostly with walls behind."""
    chance = np.random.default_rng([seed, 2])
    things = [*_table(chance), *_things(chance), *_sticks(chance), *_corner(chance)]
    lamp = (float(chance.uniform(-1.5, 1.5)), float(chance.uniform(-1.5, 0.5)), float(chance.uniform(1.1, 1.9)))
    return Scene(tuple(things), lamp, (0.0, 0.0, TOP + float(chance.uniform(0.05, 0.2))), reach=0.45)


def _table(chance: np.random.Generator) -> Iterator[Solid]:
    wide, deep = (float(value) for value in chance.uniform(0.45, 0.9, 2))
    look = draw_paint(chance, ("planks", WOODS), ("marble", STONES), ("rug", WALLS))
    yield Solid(BOX, (0, 0, TOP - 0.02), (wide, deep, 0.02), *look, grain=float(chance.uniform(0.4, 2)))
    for x in (-wide + 0.05, wide - 0.05):
        for y in (-deep + 0.05, deep - 0.05):
            yield Solid(BOX, (x, y, TOP - LEGS / 2 - 0.02), (0.03, 0.03, LEGS / 2 - 0.02), "plain", *look[1:])
    floor = draw_paint(chance, ("planks", WOODS), ("tiles", STONES))
    yield Solid(BOX, (0, 0, TOP - LEGS - 0.1), (6, 6, 0.1), *floor, casts_shadow=False)


def _things(chance: np.random.Generator) -> Iterator[Solid]:
    for _ in range(int(chance.integers(8, 31))):
        far, angle = 0.38 * math.sqrt(chance.random()), float(chance.uniform(0, 2 * math.pi))
        x, y = far * math.cos(angle), far * math.sin(angle)
        w, d, h = (float(size) for size in np.exp(chance.uniform(math.log(0.015), math.log(0.09), 3)))
        shape = int(chance.choice([BOX, BALL, CYLINDER]))
        size = (w, w, h) if shape == CYLINDER else (w, d, h)
        grain, turn = float(np.exp(chance.uniform(-2.2, -0.5))), float(chance.uniform(0, 3.1))
        yield Solid(shape, (x, y, TOP + h), size, *drawn_look(chance), turn=turn, grain=grain, seed=drawn_seed(chance))
        if shape == BOX and chance.random() < 0.3:
            top = float(chance.uniform(0.01, 0.03))
            place, above = (x, y, TOP + 2 * h + top), (0.7 * w, 0.7 * d, top)
            yield Solid(BOX, place, above, *drawn_look(chance), turn=turn + 0.3, grain=grain, seed=drawn_seed(chance))


def _sticks(chance: np.random.Generator) -> Iterator[Solid]:
    """Pencils and wires: upright, or lying along the table."""
    for _ in range(int(chance.integers(0, 6))):
        x, y = (float(value) for value in chance.uniform(-0.35, 0.35, 2))
        thin, long, look = float(chance.uniform(0.0015, 0.006)), float(chance.uniform(0.05, 0.14)), drawn_look(chance)
        if chance.random() < 0.5:
            yield Solid(CYLINDER, (x, y, TOP + long), (thin, thin, long), *look, seed=drawn_seed(chance))
        else:
            turn = float(chance.uniform(0, 3.1))
            yield Solid(BOX, (x, y, TOP + thin), (long, thin, thin), *look, turn=turn, seed=drawn_seed(chance))


def _corner(chance: np.random.Generator) -> Iterator[Solid]:
    """A wall behind, or two; or nothing, which is black."""
    walls = int(chance.integers(0, 3))
    for number in range(walls):
        away, (first, second) = float(chance.uniform(0.6, 2.5)), draw_pair(chance, WALLS)
        place, size = ((0.0, away, 0.75), (4, 0.1, 1.6)) if number == 0 else ((-away, 0.0, 0.75), (0.1, 4, 1.6))
        paint = str(chance.choice(["plaster", "brick", "poster"]))
        yield Solid(BOX, place, size, paint, first, second, casts_shadow=False, seed=drawn_seed(chance))
