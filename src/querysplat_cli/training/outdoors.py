"""Procedural scenes in the open, for training: solids on the ground and a background."""

import math
from collections.abc import Iterator

import numpy as np

from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.solids import Scene, Solid
from querysplat_cli.training.surfaces import SURFACES, drawn_look, drawn_seed


def make_outdoors(seed: int) -> Scene:
    """Six to twenty solids on the ground, some of them thin poles, in front of facades, open sky or darkness."""
    chance = np.random.default_rng([seed, 1])
    things = [*_ground(chance), *_pile(chance), *_poles(chance), *_background(chance)]
    lamp = (float(chance.uniform(-3, 3)), float(chance.uniform(-3, 1)), float(chance.uniform(1.8, 3.5)))
    return Scene(tuple(things), lamp, (0.0, 0.0, float(chance.uniform(0.2, 0.6))))


def make_fence(chance: np.random.Generator) -> Iterator[Solid]:
    """A row of thin upright bars between two rails, somewhere among the things."""
    count, gap = int(chance.integers(6, 21)), float(chance.uniform(0.03, 0.12))
    thin, high, turn = float(chance.uniform(0.003, 0.012)), float(chance.uniform(0.15, 0.5)), chance.uniform(-0.8, 0.8)
    x, y = (float(value) for value in chance.uniform((-0.6, 0.1), (0.6, 0.9)))
    look = drawn_look(chance, "plain", "planks", "marble")
    for number in range(count):
        along = (number - (count - 1) / 2) * gap
        place = (x + math.cos(turn) * along, y + math.sin(turn) * along, high)
        yield Solid(CYLINDER, place, (thin, thin, high), *look, seed=drawn_seed(chance))
    for z in (0.2 * high, 1.8 * high):
        size = (count * gap / 2, thin, 1.5 * thin)
        yield Solid(BOX, (x, y, z), size, *look, turn=float(turn), seed=drawn_seed(chance))


def _ground(chance: np.random.Generator) -> Iterator[Solid]:
    reach = float(chance.choice([1.5, 4.0, 15.0]))
    look = drawn_look(chance, "plaster", "tiles", "planks", "rug", "marble", "leaves", "plain")
    grain = float(chance.uniform(0.5, 2.0))
    yield Solid(BOX, (0, 0, -0.1), (reach, reach, 0.1), *look, grain=grain, seed=drawn_seed(chance), casts_shadow=False)


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
        yield Solid(shape, place, size, *drawn_look(chance, *SURFACES), turn=turn, grain=grain, seed=drawn_seed(chance))


def _poles(chance: np.random.Generator) -> Iterator[Solid]:
    for _ in range(int(chance.integers(0, 7))):
        x, y = chance.uniform(-1.2, 1.2, 2)
        thin, high = float(chance.uniform(0.006, 0.03)), float(chance.uniform(0.3, 1.1))
        look = drawn_look(chance, "plain", "planks", "marble")
        yield Solid(CYLINDER, (float(x), float(y), high), (thin, thin, high), *look, seed=drawn_seed(chance))


def _background(chance: np.random.Generator) -> Iterator[Solid]:
    """Facades from two to twenty metres away, and a sky, which may be missing: what no ray hits is black."""
    if chance.random() < 0.75:
        away = float(np.exp(chance.uniform(math.log(2.0), math.log(18.0))))
        for _ in range(int(chance.integers(1, 6))):
            wide, high = (float(value) for value in away * chance.uniform(0.15, 0.9, 2))
            place = (float(away * chance.uniform(-1.2, 1.2)), away + float(chance.uniform(0, 0.5)) * away, high)
            look = drawn_look(chance, "brick", "plaster", "planks", "tiles", "leaves")
            grain = float(chance.uniform(0.3, 1.0)) * max(1.0, away / 4)
            yield Solid(BOX, place, (wide, 0.3, high), *look, turn=float(chance.normal(0, 0.3)), grain=grain)
    if chance.random() < 0.85:
        first, second = (
            ((0.62, 0.74, 0.92), (0.90, 0.93, 0.97)) if chance.random() < 0.7 else drawn_look(chance, "plain")[1:]
        )
        yield Solid(BOX, (0, 45, 10), (90, 0.5, 60), "plain", first, second, grain=40.0, casts_shadow=False)
