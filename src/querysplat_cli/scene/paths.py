"""Camera paths through and around a scene."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.scene.cameras import Cameras


def orbit(cameras: Cameras, centre: Float[Tensor, "3"], frames: int) -> Cameras:
    """A closed path that looks at `centre` and stays where the input cameras are.

    Seen from `centre`, the inputs fill a patch of directions; the path is an ellipse in that patch, at their
    median distance. A ring of inputs gives a wide turn, a handful of neighbours a gentle sway. Up is the
    inputs' mean up.
    """
    offsets = cameras.centres.double() - centre.double()
    distance = offsets.norm(dim=1).median()
    forward = F.normalize(F.normalize(offsets, dim=1).mean(0), dim=0)
    up = -cameras.w2c[:, 1, :3].double().mean(0)
    right = F.normalize(torch.linalg.cross(up, forward), dim=0)
    up = torch.linalg.cross(forward, right)
    directions = F.normalize(offsets, dim=1)
    azimuth = torch.atan2(directions @ right, directions @ forward)
    elevation = torch.asin((directions @ up).clamp(-1, 1))
    turn = torch.arange(frames, dtype=torch.float64) * (2 * torch.pi / frames)
    width, height = (float(part.abs().max().clamp_min(0.03)) for part in (azimuth, elevation))
    across, above = 0.8 * width * torch.sin(turn), elevation.mean() + 0.5 * min(height, 0.2) * torch.cos(turn)
    positions = centre.double() + distance * (
        (torch.cos(above) * torch.cos(across))[:, None] * forward
        + (torch.cos(above) * torch.sin(across))[:, None] * right
        + torch.sin(above)[:, None] * up
    )
    w2c = torch.stack([look_at(position, centre.double(), up) for position in positions])
    K = cameras.K.median(0).values.expand(frames, 3, 3)
    return Cameras(w2c.to(cameras.w2c.dtype), K.contiguous(), cameras.height, cameras.width)


def look_at(position: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """World-to-camera of a camera at `position` that looks at `target` with `up` upwards (OpenCV axes)."""
    forward = F.normalize(target - position, dim=0)
    right = F.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    w2c = torch.eye(4, dtype=position.dtype)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ position
    return w2c
