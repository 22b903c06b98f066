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


def encode_pose(cameras: Cameras) -> Float[Tensor, "views 9"]:
    """The encoding with a unit quaternion of w ≥ 0. It does not contain the principal point."""
    field = torch.stack([cameras.height / 2 / cameras.K[:, 1, 1], cameras.width / 2 / cameras.K[:, 0, 0]], 1)
    return torch.cat([cameras.w2c[:, :3, 3], _quaternion(cameras.w2c[:, :3, :3]), 2 * torch.atan(field)], 1)


def _rotation(quaternion: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    x, y, z, w = quaternion.unbind(1)
    s = 2 / quaternion.square().sum(1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
        s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
        s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).unflatten(1, (3, 3))


def _quaternion(rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """x y z w, each from the row of 4·q·qᵀ with the largest diagonal, so that nothing cancels."""
    m = rotation
    diagonal = m.diagonal(dim1=1, dim2=2)
    x, y, z = diagonal.unbind(1)
    outer = torch.zeros(len(m), 4, 4, dtype=m.dtype, device=m.device)
    for i, value in enumerate((1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z)):
        outer[:, i, i] = value
    for i, j in ((0, 1), (0, 2), (1, 2)):
        outer[:, i, j] = outer[:, j, i] = m[:, i, j] + m[:, j, i]
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0))):
        outer[:, i, 3] = outer[:, 3, i] = m[:, j, k] - m[:, k, j]
    largest = outer.diagonal(dim1=1, dim2=2).argmax(1)
    row = torch.nn.functional.normalize(outer[torch.arange(len(m)), largest], dim=1)
    return torch.where(row[:, 3:] < 0, -row, row)
