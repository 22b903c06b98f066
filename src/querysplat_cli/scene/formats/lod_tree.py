"""The spatial tree of streamed files: a binary division of the scene, with the extents of what is in each part."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix

Division: TypeAlias = int | tuple[Any, Any]
"""A leaf by its number, or two divisions. Leaves are numbered from 0 from one end to the other."""
Box = Float[np.ndarray, "2 3"]
"""The least and the largest coordinates."""

EXTENT = 3.0
"""Bounds hold the ellipsoids of so many standard deviations."""
MORTON_BITS = 21
"""Of a coordinate; three of them fit an int64."""
OUTWARD = 1e-6
"""Share by which bounds are widened, so that rounding to 7 digits makes none smaller."""


def divided(centres: Float[np.ndarray, "n 3"], most: int) -> tuple[Division, Int[np.ndarray, "n"]]:
    """Halves along the longest axis, again and again, until none has more than `most` centres; the leaf of each."""
    leaf = np.zeros(len(centres), np.int64)
    leaves = 0

    def halves(rows: Int[np.ndarray, "k"]) -> Division:
        nonlocal leaves
        if len(rows) <= most:
            leaf[rows] = leaves
            leaves += 1
            return leaves - 1
        places = centres[rows]
        order = rows[np.argsort(places[:, np.ptp(places, axis=0).argmax()], kind="stable")]
        return halves(order[: len(order) // 2]), halves(order[len(order) // 2 :])

    return halves(np.arange(len(centres))), leaf


def morton_codes(centres: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Numbers whose order follows Morton's curve through the box of the centres."""
    low, size = centres.min(0), np.maximum(np.ptp(centres, axis=0), 1e-300)
    steps = ((centres - low) / size * ((1 << MORTON_BITS) - 1)).astype(np.int64)
    codes = np.zeros(len(centres), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            codes |= ((steps[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def extents(gaussians: Gaussians) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The least and the largest coordinates of each ellipsoid of `EXTENT` standard deviations."""
    axes = quaternion_to_matrix(gaussians.quats.double()) * gaussians.scales.double()[:, None, :]
    reach = EXTENT * torch.linalg.vector_norm(axes, dim=2)
    means = gaussians.means.double()
    return (means - reach).numpy(), (means + reach).numpy()


def node(part: Division, boxes: Float[np.ndarray, "leaves 2 3"], runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The tree of lod-meta.json: the bound of every part, and the runs of each leaf by level."""
    if isinstance(part, int):
        return {"bound": _bound(boxes[part]), "lods": runs[part]}
    children = [node(half, boxes, runs) for half in part]
    low = np.min([child["bound"]["min"] for child in children], 0)
    high = np.max([child["bound"]["max"] for child in children], 0)
    return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}


def _bound(box: Box) -> dict[str, list[float]]:
    low, high = box[0] - OUTWARD * np.abs(box[0]), box[1] + OUTWARD * np.abs(box[1])
    return {name: [float(f"{value:.7g}") for value in corner] for name, corner in (("min", low), ("max", high))}
