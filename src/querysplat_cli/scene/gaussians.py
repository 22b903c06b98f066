"""A scene: a set of 3D Gaussians."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.scene.tensor_dataclass import TensorDataclass

SH_0 = 0.28209479177387814
SH_1 = 0.4886025119029199
SH_2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
"""Factors of the real spherical harmonics, degree by degree, in the order and with the signs of 3DGS."""


@dataclass(frozen=True)
class Gaussians(TensorDataclass):
    """N Gaussians in world coordinates.

    `quats` are w, x, y, z, not necessarily normalised; `scales` are linear standard deviations in scene
    units; `opacities` lie in (0, 1); `sh` are real spherical harmonics in the 3DGS order and sign, so that
    colour = max(0, 0.5 + Σ sh·basis(direction)). Logs and logits exist only in files and optimisers.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n bands 3"]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def finite(self) -> Bool[Tensor, "n"]:
        """Which Gaussians have only finite numbers."""
        return torch.stack([field[:, None].flatten(1).isfinite().all(1) for field in vars(self).values()]).all(0)

    @property
    def surfaces(self) -> Bool[Tensor, "n"]:
        """Which Gaussians stand for surfaces: those that are at least half opaque, and the most opaque quarter."""
        if not len(self):
            return torch.zeros_like(self.opacities, dtype=torch.bool)
        quarter = self.opacities.kthvalue(math.ceil(0.75 * len(self))).values
        return self.opacities >= min(0.5, float(quarter))

    def __getitem__(self, index: slice | Tensor) -> "Gaussians":
        return self.map(lambda field: field[index])

    def detach(self) -> "Gaussians":
        return self.map(Tensor.detach)

    def to(self, target: torch.dtype | torch.device | str) -> "Gaussians":
        return self.map(lambda field: field.to(target))


def joined(*parts: Gaussians) -> Gaussians:
    """All Gaussians of `parts`, with as many SH bands as the part that has most."""
    bands = max(part.sh.shape[1] for part in parts)
    alike = [replace(part, sh=F.pad(part.sh, (0, 0, 0, bands - part.sh.shape[1]))) for part in parts]
    return Gaussians(*map(torch.cat, zip(*(part.tensors() for part in alike), strict=True)))
