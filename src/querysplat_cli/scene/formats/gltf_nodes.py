"""Where the nodes of a glTF file place a mesh."""

from typing import Any

import numpy as np
import torch

from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.sim3 import Sim3

TOLERANCE = 1e-4
"""How far rounding may move R·Rᵀ from the identity."""


def placement(document: dict[str, Any], mesh: int) -> Sim3 | None:
    """From the frame of a mesh to that of the file, by the first node that shows it; None where the two are one.

    Raises ValueError where that is no similarity, and anything where the file is damaged.
    """
    nodes = document.get("nodes", [])
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", ())}
    node = next((number for number, each in enumerate(nodes) if each.get("mesh") == mesh), None)
    whole, steps = np.eye(4), 0
    while node is not None:
        whole = _matrix(nodes[node]) @ whole
        node, steps = parents.get(node), steps + 1
        if steps > len(nodes):
            raise ValueError("its nodes are each other's children")
    return None if np.array_equal(whole, np.eye(4)) else _similarity(whole)


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # by columns
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    rotation = quaternion_to_matrix(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    found = np.eye(4)
    found[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    found[:3, 3] = node.get("translation", (0, 0, 0))
    return found


def _similarity(matrix: np.ndarray) -> Sim3:
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not (np.isfinite(matrix).all() and determinant > 0):
        raise ValueError("a node of it mirrors or flattens the Gaussians")
    scale = determinant ** (1 / 3)
    rotation = matrix[:3, :3] / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > TOLERANCE:
        raise ValueError("a node of it stretches the Gaussians")
    return Sim3(scale, torch.from_numpy(rotation), torch.from_numpy(matrix[:3, 3].copy()))
