"""The pose encoding of both VGMs: nine numbers for a camera (docs/reference/official-checkpoint.md).

They are translation (3), quaternion x y z w (4), and vertical and horizontal field of view in radians (2), with
world-to-camera = [R | t].
"""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras


def decode_pose(encoding: Float[Tensor, "views 9"], height: int, width: int) -> Cameras:
    """Cameras of pictures of the given size. The principal point is the middle; fx and fy follow from their angles.

    Quaternions may have any length and sign. A field of view of 0 gives an infinite focal length.
    """
    translation, quaternion, field = encoding.split([3, 4, 2], 1)
    w2c = torch.eye(4, dtype=encoding.dtype, device=encoding.device).repeat(len(encoding), 1, 1)
    w2c[:, :3, :3] = _rotation(quaternion)
    w2c[:, :3, 3] = translation
    K = torch.zeros(len(encoding), 3, 3, dtype=encoding.dtype, device=encoding.device)
    K[:, 0, 0] = width / 2 / torch.tan(field[:, 1] / 2)
    K[:, 1, 1] = height / 2 / torch.tan(field[:, 0] / 2)
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = width / 2, height / 2, 1
    return Cameras(w2c, K, height, width)


def _rotation(quaternion: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    x, y, z, w = quaternion.unbind(1)
    s = 2 / quaternion.square().sum(1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
        s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
        s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).unflatten(1, (3, 3))
