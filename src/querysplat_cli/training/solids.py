"""The solids that a procedural scene is made of."""

import math
from dataclasses import dataclass

import numpy as np

from querysplat_cli.training.raycast import BALL, CYLINDER

Number = float | int
Vector = tuple[Number, Number, Number]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """A box, ball or cylinder. Lengths are in metres, z is up, and colours are sRGB from 0 to 1.

    `size` is half the extent along each axis. `turn` is an angle about the vertical axis, in radians. `paint` is
    one of `textures.PAINTS`; it mixes the colours `first` and `second`, and `grain` is the scale of its pattern.
    `gloss` is the share of light that it reflects like a mirror, seen straight on; with 0 it reflects none.
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
    gloss: Number = 0


@dataclass(frozen=True)
class Scene:
    """Solids, the middle of the round lamp, and the point that photos are aimed at.

    `reach` is how far cameras stand away, relative to a room's.
    """

    solids: tuple[Solid, ...]
    lamp: Vector
    focus: Vector
    reach: float = 1.0


def distance_to(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Metres from points [n, 3] to the surface, or a little less; negative inside. Exact in front of a box's face."""
    offset = points - np.array(solid.centre)
    c, s = math.cos(solid.turn), math.sin(solid.turn)
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]], 1)
    size = np.array(solid.size, dtype=float)
    if solid.shape == BALL:
        return (np.linalg.norm(local / size, axis=1) - 1) * size.min()
    if solid.shape == CYLINDER:
        side = (np.linalg.norm(local[:, :2] / size[:2], axis=1) - 1) * size[:2].min()
        return np.maximum(side, np.abs(local[:, 2]) - size[2])
    return (np.abs(local) - size).max(1)
