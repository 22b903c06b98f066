"""Rotations: matrices, and unit quaternions in the order w, x, y, z.

`roma` has most of these, but it orders the same sums differently: on random rotations of float32, products and
matrices differ in the last bit for nine of ten. Scenes would then not keep their bytes.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def matrix_to_quaternion(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices, exact to rounding at every angle. Their sign is arbitrary.

    Of the four classical formulas the one with the largest divisor is taken, so nothing is divided by
    less than 1/2 (Shepperd 1978).
    """
    m = rotations
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    return F.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)


def quaternion_to_matrix(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions of any length but 0."""
    size = quats.abs().amax(1, keepdim=True)  # keeps the norm's squares in range for lengths of 1e±20
    w, x, y, z = F.normalize(quats / size, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def quaternion_product(left: Float[Tensor, "*n 4"], right: Float[Tensor, "*m 4"]) -> Float[Tensor, "*k 4"]:
    """Hamilton's product: the rotation `right`, then the rotation `left`. Batches broadcast."""
    w, x, y, z = left.unbind(-1)
    a, b, c, d = right.unbind(-1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        -1,
    )


def rotate_vectors(quats: Float[Tensor, "n 4"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Each vector, turned by its unit quaternion."""
    axis = quats[:, 1:]
    cross = torch.linalg.cross(axis, vectors)
    return vectors + 2 * (quats[:, :1] * cross + torch.linalg.cross(axis, cross))


def skew(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Matrices whose product with any x is the cross product v × x.

    Their matrix exponentials turn about v, by the length of v in radians.
    """
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def rotation_angles(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angles of rotation matrices in degrees; accurate near 0 and near 180."""
    odd = rotations - rotations.mT
    sine = torch.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]]).norm(dim=0) / 2
    cosine = (rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.atan2(sine, cosine))
