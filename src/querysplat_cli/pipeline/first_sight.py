"""The frame that viewers expect of a scene: upright, around the origin, seen from where the photos were taken."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.runtime.choices import FileFrame
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import scene_middle
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.upright import up_direction

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
"""Files of Gaussians have y down."""


def first_sight(gaussians: Gaussians, cameras: Cameras, frame: FileFrame = "upright") -> Sim3 | None:
    """The similarity from the frame of a scene to the one in which it is written; None where these are one."""
    return None if frame == "vgm" else upright_frame(gaussians, cameras)


def upright_frame(gaussians: Gaussians, cameras: Cameras) -> Sim3:
    """The similarity from the frame of a scene to the one that viewers expect.

    There up is −y, and the origin is the median centre of the opaque Gaussians. The photo in the middle of all
    directions of view was taken from the azimuth and, in the median, the distance that `PipelinePolicy` names.
    """
    middle = scene_middle(gaussians).double()
    up = torch.from_numpy(up_direction(cameras))
    turn = axes(UP, _azimuth(PIPELINE_POLICY.first_sight_azimuth)) @ axes(up, _front(cameras, up)).T
    distance = float((cameras.centres.double() - middle).norm(dim=1).median())
    scale = PIPELINE_POLICY.first_sight_distance / distance if distance > 0 else 1.0
    return Sim3(scale, turn, -scale * turn @ middle)


def axes(up: Float[Tensor, "3"], front: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation whose columns are `front`, as far as it is level, then `up`, then what is left of a viewer there."""
    front = F.normalize(front - (front @ up) * up, dim=0)
    return torch.stack([front, up, torch.linalg.cross(front, up)], 1)


def _front(cameras: Cameras, up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Level, and against the direction of view of the photo whose direction is most like all others'.

    It follows from the picture's horizontal axis, which is level even where a photo looks straight down.
    """
    back = F.normalize(torch.linalg.cross(cameras.w2c[:, 0, :3].double(), up.expand(len(cameras), 3)), dim=1)
    return back[(back @ back.T).clamp(-1, 1).acos().sum(1).argmin()]


def _azimuth(degrees: float) -> Float[Tensor, "3"]:
    angle = math.radians(degrees)
    return torch.tensor([math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
