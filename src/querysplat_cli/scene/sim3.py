"""Similarities of 3D space: x ↦ scale·R·x + t."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import ImpossibleScene

FEWEST_WITH_OUTLIER = 4
"""With fewer cameras no outlier is sought: three that agree in rotation, direction and scale must remain."""
OUTLIER_RATIO = 5.0
"""A camera is an outlier if its error is at least this many times the largest error of the others."""
PERFECT_FIT = 1e-6
"""Errors below this count as this much, so that rounding makes no outliers."""


class DegenerateAlignment(ImpossibleScene):
    """The cameras leave part of the similarity free."""


@dataclass(frozen=True)
class Sim3:
    """x ↦ scale·rotation·x + translation, in float64."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    @staticmethod
    def identity() -> "Sim3":
        return Sim3(1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def inverse(self) -> "Sim3":
        rotation = self.rotation.T
        return Sim3(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def after(self, first: "Sim3") -> "Sim3":
        """The similarity that applies `first`, and then this one."""
        return Sim3(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.scale * self.rotation @ first.translation + self.translation,
        )

    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Transformed points, in the dtype of `points`."""
        moved = self.scale * points.double() @ self.rotation.T + self.translation
        return moved.to(points.dtype)


def rigid(w2c: Float[Tensor, "4 4"]) -> Sim3:
    """The motion of the world after which the camera `w2c` is the origin. Lengths stay as they are."""
    return Sim3(1.0, w2c[:3, :3].double(), w2c[:3, 3].double())


def align_cameras(source: Float[Tensor, "n 4 4"], target: Float[Tensor, "n 4 4"]) -> Sim3:
    """Similarity that maps the world of `source` onto the world of `target`, from n shared cameras.

    Both are world-to-camera matrices of the same cameras in two frames. The rotation is the chordal mean of the
    relative camera rotations, so that two cameras, or cameras in a row, are enough. The scale is the least-squares
    one between the centres around their means, and the translation maps one mean onto the other. Of four or more
    cameras, an outlier is left out. Raises DegenerateAlignment with fewer than two cameras, when the centres coincide
    (the scale is then free), and when no positive scale fits.
    """
    a, b = source.double(), target.double()
    outlier = _outlier(a, b)
    if outlier is None:
        return _align_all(a, b)
    rest = [i for i in range(len(a)) if i != outlier]
    return _align_all(a[rest], b[rest])


def _outlier(a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> int | None:
    """The camera that fits worst when the others are aligned without it, if its error is that of an outlier."""
    if len(a) < FEWEST_WITH_OUTLIER:
        return None
    worst, without = 1.0, None
    for i in range(len(a)):
        rest = [j for j in range(len(a)) if j != i]
        try:
            error = _errors(_align_all(a[rest], b[rest]), a, b)
        except DegenerateAlignment:
            continue
        ratio = float(error[i] / error[rest].max().clamp_min(PERFECT_FIT))
        if ratio > max(worst, OUTLIER_RATIO):
            worst, without = ratio, i
    return without


def _errors(similarity: Sim3, a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n"]:
    """For each camera: chordal distance of rotations, plus distance of centres in units of their median spread."""
    centres_a, centres_b = _centres(a), _centres(b)
    turned = a[:, :3, :3] @ similarity.rotation.T - b[:, :3, :3]
    apart = (similarity.apply(centres_a) - centres_b).norm(dim=1)
    spread = (centres_b - centres_b.median(0).values).norm(dim=1).median().clamp_min(1e-30)
    return turned.flatten(1).norm(dim=1) + apart / spread


def _centres(w2c: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 3"]:
    return -(w2c[:, :3, :3].mT @ w2c[:, :3, 3:]).squeeze(-1)


def _align_all(a: Float[Tensor, "n 4 4"], b: Float[Tensor, "n 4 4"]) -> Sim3:
    """The similarity that fits all cameras."""
    rotation_a, rotation_b = a[:, :3, :3], b[:, :3, :3]
    centres_a, centres_b = _centres(a), _centres(b)
    u, _, vt = torch.linalg.svd((rotation_b.mT @ rotation_a).sum(0))
    sign = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt))], dtype=torch.float64))
    rotation = u @ sign @ vt
    around_a, around_b = centres_a - centres_a.mean(0), centres_b - centres_b.mean(0)
    spread = around_a.square().sum()
    sides = (around_a, centres_a), (around_b, centres_b)
    if len(a) < 2 or any(around.norm() <= 1e-9 * some.abs().max().clamp_min(1e-30) for around, some in sides):
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


def least_squares_fit(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """The scale of the similarity that maps the places `source` [n, 3] onto `target`, and the distances [n] left.

    It is the one of the least weighted squares (Umeyama 1991). The scale is 0 where all of `source` is one place.
    """
    share = (weights / weights.sum())[:, None]
    a, b = source - (share * source).sum(0), target - (share * target).sum(0)
    spread = float((share * a**2).sum())
    if spread <= 0:
        return 0.0, np.linalg.norm(b, axis=1)
    u, values, vt = np.linalg.svd((share * b).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((values * sign).sum()) / spread
    return scale, np.linalg.norm(b - scale * a @ (u * sign @ vt).T, axis=1)
