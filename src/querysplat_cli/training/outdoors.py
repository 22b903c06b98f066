"""Procedural scenes in the open, for training: solids on the ground and a background."""

import math
from collections.abc import Iterator

import numpy as np

from querysplat_cli.training.palettes import BRICKS, FABRICS, FLOWERS, GREENS, STONES, WALLS, WOODS
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.solids import Colour, Scene, Solid

PALETTES = (*WOODS, *STONES, *BRICKS, *WALLS, *FABRICS, *GREENS, *FLOWERS)
SURFACES = ("plaster", "brick", "planks", "tiles", "poster", "rug", "marble", "leaves", "plain")


def make_outdoors(seed: int) -> Scene:
    """Six to twenty solids on the ground, some of them thin poles, in front of facades, open sky or darkness."""
    chance = np.random.default_rng([seed, 1])
    things = [*_ground(chance), *_pile(chance), *_poles(chance), *_background(chance)]
    lamp = (float(chance.uniform(-3, 3)), float(chance.uniform(-3, 1)), float(chance.uniform(1.8, 3.5)))
    return Scene(tuple(things), lamp, (0.0, 0.0, float(chance.uniform(0.2, 0.6))))


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
