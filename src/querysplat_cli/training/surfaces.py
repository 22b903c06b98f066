"""How surfaces of varied procedural scenes look: paints and palettes, dark ones, and glossy ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from querysplat_cli.training.palettes import BRICKS, FABRICS, FLOWERS, GREENS, STONES, WALLS, WOODS
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.solids import Colour, Solid

PALETTES = (*WOODS, *STONES, *BRICKS, *WALLS, *FABRICS, *GREENS, *FLOWERS)
SURFACES = ("plaster", "brick", "planks", "tiles", "poster", "rug", "marble", "leaves", "plain")


def drawn_look(chance: np.random.Generator, *paints: str) -> tuple[str, Colour, Colour]:
    """A paint, any by default, and two colours of one palette, darkened a little."""
    first, second = PALETTES[int(chance.integers(len(PALETTES)))]
    light = float(chance.uniform(0.45, 1.0))
    return str(chance.choice(paints or SURFACES)), _scaled(first, light), _scaled(second, light)


def drawn_seed(chance: np.random.Generator) -> int:
    return int(chance.integers(2**31))


def with_dark_and_glossy(solids: Sequence[Solid], chance: np.random.Generator) -> tuple[Solid, ...]:
    """The solids, of which the policy's shares are dark or glossy. A scene may have none of either."""
    policy = TRAINING_POLICY
    dark, glossy = policy.dark_share * chance.random(), policy.glossy_share * chance.random()
    found = []
    for solid in solids:
        if chance.random() < dark:
            light = float(chance.uniform(*policy.darkness))
            solid = replace(solid, first=_scaled(solid.first, light), second=_scaled(solid.second, light))
        if chance.random() < glossy:
            solid = replace(solid, gloss=float(chance.uniform(*policy.gloss)))
        found.append(solid)
    return tuple(found)


def _scaled(colour: Colour, light: float) -> Colour:
    red, green, blue = (float(np.clip(light * part, 0, 1)) for part in colour)
    return red, green, blue
