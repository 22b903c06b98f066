"""Draw the mesh of a scene from one of its cameras, in its colours and by its slopes, for docs/images/mesh.jpg.

    querysplat reconstruct "$QUERYSPLAT_DATA/fortress/images" -o fortress.ply
    querysplat convert fortress.ply mesh.ply --mesh
    python benchmarks/mesh_picture.py fortress mesh.ply [--picture docs/images/mesh.jpg]

Triangles are drawn by the package's own splatter, as small opaque Gaussians at their middles.
"""

import argparse
from pathlib import Path

from querysplat_cli.commands.compared_views import cameras_beside
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.pictures import eight_bit
from querysplat_cli.splat.render import render

import cv2
import numpy as np
import torch
import trimesh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--picture", type=Path, default=Path("docs/images/mesh.jpg"))
    arguments = parser.parse_args()
    beside = cameras_beside(arguments.scene)
    if beside is None:
        parser.error(f"{arguments.scene} has no cameras.json")
    inputs, frame = beside
    mesh = trimesh.load(arguments.mesh, process=False, force="mesh")
    camera = inputs.cameras[[len(inputs.names) // 2]]
    places = frame.inverse().apply(torch.tensor(mesh.triangles_center)).float()
    size = torch.tensor(mesh.area_faces).sqrt().float() / frame.scale / 2
    colours = torch.tensor(mesh.visual.vertex_colors[:, :3] / 255).float()[torch.tensor(mesh.faces)].mean(1)
    normals = torch.tensor(np.array(mesh.face_normals)) @ frame.rotation
    slopes = -(normals @ camera.w2c[0, 2, :3].double())
    drawn = [drawing(places, size, each) for each in (colours, slopes.float().clamp(0, 1)[:, None].repeat(1, 3))]
    pictures = [eight_bit(render(each, camera, background=torch.ones(3)).colour[0].clamp(0, 1)) for each in drawn]
    cv2.imwrite(str(arguments.picture), cv2.hconcat(pictures)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def drawing(places: torch.Tensor, size: torch.Tensor, colours: torch.Tensor) -> Gaussians:
    count = len(places)
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    sh = ((colours - 0.5) / SH_0)[:, None]
    return Gaussians(places, upright, size[:, None].repeat(1, 3).clamp_min(1e-5), torch.full((count,), 0.99), sh)


if __name__ == "__main__":
    main()
