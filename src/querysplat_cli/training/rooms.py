"""Procedural rooms: the subject of the demo, and training data without a download."""

from dataclasses import replace

import numpy as np

from querysplat_cli.training import furniture
from querysplat_cli.training.solids import Scene


def make_room(seed: int) -> Scene:
    """A furnished room of about 7 × 6 metres. The seed decides the furniture, its places, patterns and colours."""
    chance = np.random.default_rng(seed)
    side = float(chance.choice([-1, 1]))
    wide, deep = float(chance.uniform(3.1, 3.7)), float(chance.uniform(2.0, 2.4))
    parts = [
        *furniture.make_shell(chance, wide, deep),
        *furniture.make_rug(chance),
        *furniture.make_shelf(chance, side * chance.uniform(1.5, 1.8), deep),
        *furniture.make_sofa(chance, -side * chance.uniform(0.8, 1.1), deep),
        *furniture.make_pictures(chance, -side, wide, deep),
        *furniture.make_table(chance, side * chance.uniform(0.0, 0.25), chance.uniform(-0.25, 0.0)),
        *furniture.make_plant(chance, -side * (wide - 0.75), deep - 0.55),
        *furniture.make_lamp(chance, side * 0.55, deep - 0.4),
        *furniture.make_crates(chance, side * chance.uniform(1.6, 1.9), chance.uniform(-0.1, 0.3)),
        *furniture.make_statue(chance, -side * chance.uniform(1.75, 2.05), chance.uniform(-0.5, -0.2)),
    ]
    numbered = tuple(replace(part, seed=int(chance.integers(2**31))) for part in parts)
    return Scene(numbered, (-side * 0.9, -0.9, 2.65), (0.0, 0.5, 0.75))
