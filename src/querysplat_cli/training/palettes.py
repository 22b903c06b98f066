"""Pairs of sRGB colours for the paints of procedural scenes, by material."""

import numpy as np

from querysplat_cli.training.solids import Colour

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


def draw_pair(chance: np.random.Generator, pairs: Pairs) -> tuple[Colour, Colour]:
    """Both colours of one pair."""
    return pairs[int(chance.integers(len(pairs)))]


def draw_paint(chance: np.random.Generator, *choices: tuple[str, Pairs]) -> tuple[str, Colour, Colour]:
    """One of the paints, with a pair of the colours that stand beside it."""
    paint, pairs = choices[int(chance.integers(len(choices)))]
    return paint, *draw_pair(chance, pairs)
