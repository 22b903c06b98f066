"""How much of a film around the scene shows what no photo saw."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import orbit, scene_middle
from querysplat_cli.splat.render import render

FRAMES = 16
"""Frames of the film that is measured, evenly spaced."""
SIDE = 160
"""Longer side of its pictures, and of those of the photos, in pixels."""
BEHIND = 1.05
"""A photo shows a point that is farther away than what the photo's own render shows by less than this factor."""


@dataclass(frozen=True)
class Unseen:
    """Shares of the pixels of the film, from 0 to 1.

    empty: less than half covered by Gaussians, so that mostly the background shows.
    hidden: covered, but where the pixel's surface is, no photo looks: it lies outside every photo, or in every photo
        something nearer hides it.
    """

    empty: float
    hidden: float

    def entry(self) -> dict[str, float]:
        """For the report."""
        parts = {"share": self.empty + self.hidden, "empty": self.empty, "hidden": self.hidden}
        return {name: round(part, 4) for name, part in parts.items()}


@torch.no_grad()
def unseen(gaussians: Gaussians, cameras: Cameras, sizes: Sequence[tuple[int, int]] | None = None) -> Unseen | None:
    """Of the film of `querysplat render --cameras orbit`, around a scene with these input cameras.

    `sizes` are those of the photos on their canvas (`Cameras.of_pictures`).

    None where there is no such film, because the cameras stand at what they look at.
    """
    factor = SIDE / max(cameras.height, cameras.width)
    inputs = cameras.resized(round(factor * cameras.height), round(factor * cameras.width))
    small = sizes and [(max(1, round(factor * height)), max(1, round(factor * width))) for height, width in sizes]
    photos = inputs.of_pictures(small)
    shaped = replace(inputs, height=photos[0].height, width=photos[0].width)
    try:
        film = orbit(shaped, scene_middle(gaussians), FRAMES)
    except QuerySplatError:
        return None
    # In one block: small pictures among the freed tensors of renders may keep these from being used again.
    depths = torch.zeros(len(photos), inputs.height, inputs.width)
    for photo, depth in zip(photos, depths, strict=True):
        depth[: photo.height, : photo.width] = render(gaussians, photo).depth[0]
    empty, hidden = [], []
    for frame in range(len(film)):
        camera = film[[frame]]
        drawn = render(gaussians, camera)
        covered = drawn.alpha[0] >= 0.5
        columns, rows = torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5
        points = camera.unproject(drawn.depth, columns, rows)[0][covered]
        empty.append((~covered).float().mean())
        hidden.append((~_seen(points, photos, depths)).sum() / covered.numel())
    return Unseen(float(torch.stack(empty).mean()), float(torch.stack(hidden).mean()))


def _seen(
    points: Float[Tensor, "n 3"], photos: Sequence[Cameras], depths: Float[Tensor, "views height width"]
) -> Bool[Tensor, "n"]:
    """Whether any photo shows the points: inside its picture, and with nothing nearer in front of them."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for photo, depth in zip(photos, depths, strict=True):
        fx, fy, cx, cy = photo.intrinsics
        x, y, z = photo.local(points, 0).unbind(1)
        inside = photo.sees(points, 0)
        near = z.clamp_min(torch.finfo(z.dtype).tiny)
        column = (fx * x / near + cx).nan_to_num().clamp(0, photo.width - 1).long()
        row = (fy * y / near + cy).nan_to_num().clamp(0, photo.height - 1).long()
        seen |= inside & (z <= BEHIND * depth[row, column])
    return seen
