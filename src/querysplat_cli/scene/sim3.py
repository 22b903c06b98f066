"""Similarities of 3D space: x ↦ scale·R·x + t."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import ImpossibleScene

MANY_ENOUGH = 4
"""Cameras from which one that is wrong can be told: without it, three agree in rotation, direction and scale."""
OUTLYING = 5.0
"""How many times further off than any other a camera must be to be left out."""
NOISE = 1e-6
"""Error below which cameras agree perfectly."""


class DegenerateAlignment(ImpossibleScene):
    """The correspondences leave part of the similarity free."""


@dataclass(frozen=True)
class Sim3:
    """x ↦ scale·rotation·x + translation, in float64."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    @staticmethod
    def identity() -> "Sim3":
        return Sim3(1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Transformed points, in the dtype of `points`."""
        moved = self.scale * points.double() @ self.rotation.T + self.translation
        return moved.to(points.dtype)

    def inverse(self) -> "Sim3":
        rotation = self.rotation.T
        return Sim3(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def align_cameras(source: Float[Tensor, "n 4 4"], target: Float[Tensor, "n 4 4"]) -> Sim3:
    """Similarity that maps the world of `source` onto the world of `target`, from n shared cameras.

    Both are world-to-camera matrices of the same cameras in two frames. Rotation is the chordal mean of
    the relative camera rotations, so that two cameras, or cameras in a row, are enough; scale is the
    ratio of the spreads of the centres and translation joins their means. Of four or more cameras, one
    that does not fit while the others agree without it is left out. Raises DegenerateAlignment with fewer
    than two cameras, when the centres coincide (scale is then free), or no positive scale fits.
    """
    a, b = source.double(), target.double()
    outlier = _outlier(a, b)
    if outlier is None:
        return _align_all(a, b)
    rest = [i for i in range(len(a)) if i != outlier]
    return _align_all(a[rest], b[rest])


def _outlier(a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> int | None:
    """The camera without which the others agree at least `OUTLYING` times better, and which is as far off."""
    if len(a) < MANY_ENOUGH:
        return None
    worst, without = 1.0, None
    for i in range(len(a)):
        rest = [j for j in range(len(a)) if j != i]
        try:
            error = _errors(_align_all(a[rest], b[rest]), a, b)
        except DegenerateAlignment:
            continue
        ratio = float(error[i] / error[rest].max().clamp_min(NOISE))
        if ratio > max(worst, OUTLYING):
            worst, without = ratio, i
    return without


def _errors(similarity: Sim3, a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n"]:
    """Of each camera: chordal distance of rotations, and distance of centres in units of their median spread."""
    centres_a, centres_b = _centres(a), _centres(b)
    turned = a[:, :3, :3] @ similarity.rotation.T - b[:, :3, :3]
    apart = (similarity.apply(centres_a) - centres_b).norm(dim=1)
    spread = (centres_b - centres_b.median(0).values).norm(dim=1).median().clamp_min(1e-30)
    return turned.flatten(1).norm(dim=1) + apart / spread


def _centres(w2c: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 3"]:
    return -(w2c[:, :3, :3].mT @ w2c[:, :3, 3:]).squeeze(-1)


def _align_all(a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> Sim3:
    """The similarity of all cameras."""
    rotation_a, rotation_b = a[:, :3, :3], b[:, :3, :3]
    centres_a, centres_b = _centres(a), _centres(b)
    u, _, vt = torch.linalg.svd((rotation_b.mT @ rotation_a).sum(0))
    sign = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt))], dtype=torch.float64))
    rotation = u @ sign @ vt
    around_a, around_b = centres_a - centres_a.mean(0), centres_b - centres_b.mean(0)
    spread = around_a.square().sum()
    size = centres_a.abs().max().clamp_min(1e-30)
    if len(a) < 2 or spread.sqrt() <= 1e-9 * size:
        raise DegenerateAlignment(
            f"{len(a)} cameras at one place do not fix the scale between two reconstructions",
            "Use photos taken from at least two places.",
        )
    scale = float(((around_a @ rotation.T) * around_b).sum() / spread)
    if not scale > 0:
        raise DegenerateAlignment(
            "the two sets of cameras do not agree: no positive scale maps one onto the other",
            "At least one of the two reconstructions is wrong; add photos that overlap more.",
        )
    return Sim3(scale, rotation, centres_b.mean(0) - scale * rotation @ centres_a.mean(0))
