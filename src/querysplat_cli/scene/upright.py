"""Which way is up, as the cameras of hand-held photos show it."""

import numpy as np

from querysplat_cli.scene.cameras import Cameras

LEVEL_WEIGHT = 1e3
"""Weight of the pictures' horizontal axes relative to their vertical ones."""
ROLLED = 0.5
"""A picture whose horizontal axis rises by more than this sine (30°) was not held level."""
SHORTEST_UP = 1e-9
"""The mean up direction of pictures that contradict each other is shorter, and says nothing."""
ROUNDS = 5
"""Rounds in which such pictures are looked for."""


def up_direction(cameras: Cameras) -> np.ndarray:
    """Unit vector [3]: the mean up direction of the pictures, less its part along their horizontal axes.

    People hold cameras level but tilt them up and down, so the x axes are at right angles to the true vertical.
    Pictures that were turned on their side, or upside down, do not count as long as most are level. Where all pictures
    look the same way, their common tilt remains.
    """
    rotation = cameras.w2c[:, :3, :3].double().numpy()
    kept = np.ones(len(rotation), dtype=bool)
    for _ in range(ROUNDS):
        up = _common(rotation[kept])
        level = (np.abs(rotation[:, 0] @ up) <= ROLLED) & (rotation[:, 1] @ up < 0)
        if not level.any() or (level == kept).all():
            break
        kept = level
    return _common(rotation[kept])


def _common(rotation: np.ndarray) -> np.ndarray:
    level = np.einsum("vi,vj->ij", rotation[:, 0], rotation[:, 0]) / len(rotation)
    up: np.ndarray = np.linalg.solve(np.eye(3) + LEVEL_WEIGHT * level, -rotation[:, 1].mean(0))
    length = float(np.linalg.norm(up))
    return up / length if length > SHORTEST_UP else -rotation[0, 1]
