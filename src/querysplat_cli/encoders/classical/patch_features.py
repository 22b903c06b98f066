"""Hand-made features of each patch, in the place of a network's."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews

PATCH = 6
"""Side of a patch, in pixels."""
FEATURE_CHANNELS = 12


def patch_features(
    posed: PosedViews, depth: Float[Tensor, "views height width"], confidence: Float[Tensor, "views height width"]
) -> Float[Tensor, "views tokens 12"]:
    """Twelve numbers for each patch of 6 × 6 pixels, view by view, row by row.

    They are: world position (3), world normal (3), mean confidence, mean colour − ½ (3), log depth, and the standard
    deviation of the brightness. Position and depth are those of the patch's middle pixel.
    """
    cameras = posed.cameras
    z = depth[:, PATCH // 2 :: PATCH, PATCH // 2 :: PATCH]
    world = cameras.patch_places(depth, PATCH)
    across, down = torch.gradient(world, dim=(2, 1))
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    images = posed.views.images
    colour = torch.nn.functional.avg_pool2d(images, PATCH)
    brightness = images.mean(1, keepdim=True)
    mean = torch.nn.functional.avg_pool2d(brightness, PATCH)
    texture = (torch.nn.functional.avg_pool2d(brightness.square(), PATCH) - mean.square()).clamp_min(0).sqrt()
    sure = torch.nn.functional.avg_pool2d(confidence[:, None], PATCH)
    maps = [world, normal, sure.permute(0, 2, 3, 1), colour.permute(0, 2, 3, 1) - 0.5, z.log()[..., None]]
    return torch.cat([*maps, texture.permute(0, 2, 3, 1)], -1).flatten(1, 2)
