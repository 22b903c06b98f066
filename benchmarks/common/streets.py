"""A procedural street: houses on both sides of a road, and a walk along it."""

import math
from collections.abc import Iterator

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training.photographer import aimed
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.solids import Scene, Solid
from querysplat_cli.training.surfaces import SURFACES, drawn_look, drawn_seed

import numpy as np

HALF_ROAD = 3.5
"""From the middle of the road to the houses, in metres."""
EYE = 1.6
"""Height of the cameras above the road, in metres."""


def make_street(seed: int, length: float) -> Scene:
    """Houses with windows, trees and things on a road of so many metres along +x, under an open sky."""
    chance = np.random.default_rng([seed, 7])
    ground = Solid(
        BOX, (length / 2, 0, -0.1), (length, HALF_ROAD + 4, 0.1), *drawn_look(chance, "tiles"), seed=drawn_seed(chance)
    )
    sky = Solid(
        BOX, (length / 2, 0, 40), (length + 300, 300, 0.5), "plain", (0.62, 0.74, 0.92), (0.9, 0.93, 0.97), grain=40.0,
        casts_shadow=False,
    )  # fmt: skip
    ends = [
        Solid(BOX, (x, 0, 4), (0.4, HALF_ROAD + 4, 4), *drawn_look(chance, "brick"), seed=drawn_seed(chance))
        for x in (-4.0, length + 4.0)
    ]
    sides = [solid for side in (-1, 1) for solid in _side(chance, side, length)]
    return Scene((ground, sky, *ends, *sides), (length / 2, 0.0, 30.0), (length / 2, HALF_ROAD, EYE), length / 3)


def stroll(length: float, views: int, seed: int, height: int, width: int) -> Cameras:
    """Cameras at even steps along the road, with a focal length of 0.8 longer sides.

    They look at the houses on the left, 25° ahead, and are off by a few centimetres and degrees.
    """
    chance = np.random.default_rng([seed, views, 8])
    x = np.linspace(0.0, length, views)
    eye = np.stack([x, -1.0 + chance.uniform(-0.15, 0.15, views), EYE + chance.uniform(-0.1, 0.1, views)], 1)
    ahead = math.tan(math.radians(25)) + chance.normal(0, 0.06, views)
    target = eye + np.stack([ahead, np.ones(views), chance.normal(0.05, 0.04, views)], 1)
    return aimed(eye, target, 0.8 * max(height, width), height, width, roll=chance.normal(0, 0.02, views))


def _side(chance: np.random.Generator, side: int, length: float) -> Iterator[Solid]:
    """Houses of 2 to 5 metres, each with windows, and a tree or a thing in front of some."""
    x = -4.0
    while x < length + 4:
        wide, high = float(chance.uniform(2.0, 5.0)), float(chance.uniform(3.0, 7.0))
        back = float(chance.uniform(0, 0.8))
        look = drawn_look(chance, "brick", "plaster", "planks", "tiles", "marble")
        place = (x + wide / 2, side * (HALF_ROAD + 2 + back), high / 2)
        yield Solid(BOX, place, (wide / 2, 2, high / 2), *look, grain=0.6, seed=drawn_seed(chance))
        yield from _windows(chance, x, wide, high, side * (HALF_ROAD + back))
        if chance.random() < 0.6:
            yield from _tree(chance, x + wide * float(chance.random()), side * (HALF_ROAD - 0.6))
        if chance.random() < 0.8:
            size = tuple(float(each) for each in chance.uniform(0.15, 0.45, 3))
            look = drawn_look(chance, *SURFACES)
            where = (x + wide * float(chance.random()), side * (HALF_ROAD - 0.5), size[2])
            yield Solid(BOX, where, size, *look, turn=float(chance.uniform(0, 3)), grain=0.5, seed=drawn_seed(chance))  # type: ignore[arg-type]
        x += wide + float(chance.uniform(0, 0.3))


def _windows(chance: np.random.Generator, x: float, wide: float, high: float, y: float) -> Iterator[Solid]:
    look = drawn_look(chance, "poster", "planks", "plain", "rug")
    for column in range(max(1, int(wide / 1.3))):
        for row in range(max(1, int(high / 1.8))):
            place = (x + 0.7 + 1.3 * column, y, 1.1 + 1.8 * row)
            yield Solid(BOX, place, (0.35, 0.08, 0.5), *look, grain=0.4, seed=drawn_seed(chance))


def _tree(chance: np.random.Generator, x: float, y: float) -> Iterator[Solid]:
    high = float(chance.uniform(0.7, 1.3))
    yield Solid(CYLINDER, (x, y, high), (0.07, 0.07, high), *drawn_look(chance, "planks"), seed=drawn_seed(chance))
    wide = float(chance.uniform(0.3, 0.6))
    crown = (wide, wide, float(chance.uniform(0.4, 0.8)))
    yield Solid(BALL, (x, y, 2 * high), crown, *drawn_look(chance, "leaves"), grain=0.3, seed=drawn_seed(chance))
