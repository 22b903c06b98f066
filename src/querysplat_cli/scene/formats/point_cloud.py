"""A coloured point cloud: of the opaque Gaussians, and as a .ply that other tools read."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyElement

from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.gaussians import SH_0, Gaussians


@dataclass(frozen=True)
class PointCloud:
    """Points in the frame and the units of the scene, and their colours."""

    places: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.places)


def points_of(gaussians: Gaussians) -> PointCloud:
    """The centres of the Gaussians that stand for surfaces, in their colours without the view's part."""
    opaque = gaussians[gaussians.surfaces]
    colours = (0.5 + SH_0 * opaque.sh[:, 0]).clamp(0, 1) * 255
    return PointCloud(opaque.means.numpy().astype(np.float32), colours.round().numpy().astype(np.uint8))


def write_points(path: Path, points: PointCloud) -> None:
    """Write a binary .ply with x, y, z and red, green, blue, whole or not at all."""
    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.zeros(len(points), kinds)
    for column, name in enumerate("xyz"):
        vertices[name] = points.places[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = points.colours[:, column]
    with atomic_path(path) as draft:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(draft))
