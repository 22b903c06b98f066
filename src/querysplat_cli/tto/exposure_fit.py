"""Least squares for the colour transforms of photos: one for each photo, pulled towards the identity.

Here they are fitted to points that several photos show. `exposure_refit` goes on during optimisation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.scene.cameras import Cameras, distances
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.exposure_policy import EXPOSURE_POLICY
from querysplat_cli.tto.exposure_samples import ColourSamples, sample_colours


@dataclass(frozen=True)
class PhotoColours:
    """The transforms that the photos ask for, and how much the transforms of neighbouring photos differ.

    `disagreement` is in shares of a channel's range.
    """

    exposures: Exposures
    disagreement: float

    @property
    def agree(self) -> bool:
        """Whether the scene can show the photos without transforms."""
        return self.disagreement < EXPOSURE_POLICY.disagreement

    @property
    def needed(self) -> Exposures | None:
        """The transforms; None where the scene can do without."""
        return None if self.agree else self.exposures


def compare_photos(views: Views, cameras: Cameras, geometry: Geometry) -> PhotoColours:
    """Fit the transforms to the colours of points that several views show."""
    samples = sample_colours(views, cameras, geometry)
    exposures, points = fit_samples(samples, len(views))
    odd = samples.point % 2 == 1
    halves = [fit_samples(samples.chosen(half), len(views))[0] for half in (odd, ~odd)]
    return PhotoColours(exposures, _disagreement(halves, points[samples.point], samples, cameras))


def fit_samples(samples: ColourSamples, views: int) -> tuple[Exposures, Float[Tensor, "points 3"]]:
    """The transforms of the views and the colours of the points that explain the observations best.

    Both are found by turns, each by least squares. Weights that follow the errors make the sum of their sizes, not of
    their squares, small.
    """
    exposures, weights = Exposures.identity(views), torch.ones(len(samples), dtype=torch.float64)
    count = torch.bincount(samples.view, minlength=views)
    for _ in range(EXPOSURE_POLICY.iterations):
        points = _point_colours(exposures, samples, weights)
        seen = points[samples.point]
        error = (_applied(exposures.matrices[samples.view], seen) - samples.colour).norm(dim=1)
        weights = 1 / (error + EXPOSURE_POLICY.error_floor)
        known = torch.cat([seen, torch.ones_like(seen[:, :1])], 1)
        heavy = weights[:, None] * known
        normal = _summed(heavy[:, :, None] * known[:, None], samples.view, views)
        right = _summed(heavy[:, :, None] * samples.colour[:, None], samples.view, views)
        matrices = solve(normal, right, _summed(weights, samples.view, views))
        enough = (count >= EXPOSURE_POLICY.fewest_observations)[:, None, None]
        exposures = _with_identity_mean_of(Exposures(torch.where(enough, matrices, _IDENTITY)), enough.flatten())
    return exposures, _point_colours(exposures, samples, weights)


def solve(
    normal: Float[Tensor, "*views 4 4"], right: Float[Tensor, "*views 4 3"], weight: Float[Tensor, "*views"]
) -> Float[Tensor, "*views 3 4"]:
    """The transform of least squares, from Σ w·x·xᵀ, Σ w·x·yᵀ and Σ w, with a ridge around the identity."""
    ridge = (EXPOSURE_POLICY.ridge * weight + 1e-9)[..., None, None]
    square = torch.eye(4, dtype=normal.dtype, device=normal.device)
    return torch.linalg.solve(normal + ridge * square, right + ridge * square[:, :3]).mT


_IDENTITY = torch.eye(3, 4, dtype=torch.float64)


def _disagreement(
    halves: Sequence[Exposures], colours: Float[Tensor, "n 3"], samples: ColourSamples, cameras: Cameras
) -> float:
    """How far each view's transform is from the mean of the others', weighted by the inverse squared distance.

    Root mean square over views and over channels of the colours that the view shows. The square is the product of what
    two `halves` of the points find. Their errors are independent, and do not add up to a disagreement.
    """
    distance = distances(cameras.centres.double(), cameras.centres.double())
    nearness = 1 / (distance.square() + 1e-6 * distance.max().square() + 1e-12)
    nearness.fill_diagonal_(0)
    nearness /= nearness.sum(1, keepdim=True)
    one, other = (
        _applied((half.matrices - torch.einsum("vo,oij->vij", nearness, half.matrices))[samples.view], colours)
        for half in halves
    )
    count = torch.bincount(samples.view, minlength=len(cameras))
    by_view = _summed((one * other).mean(1), samples.view, len(cameras))[count > 0] / count[count > 0]
    return float(by_view.mean().clamp_min(0).sqrt()) if len(by_view) else 0.0


def _with_identity_mean_of(exposures: Exposures, chosen: Bool[Tensor, "views"]) -> Exposures:
    """The mean of the `chosen` becomes the identity; the others stay."""
    if not bool(chosen.any()):
        return exposures
    matrices = exposures.matrices.clone()
    matrices[chosen] = Exposures(matrices[chosen]).with_identity_mean().matrices
    return Exposures(matrices)


def _point_colours(
    exposures: Exposures, samples: ColourSamples, weights: Float[Tensor, "n"]
) -> Float[Tensor, "points 3"]:
    """The colour of each point that fits its observations best, by weighted least squares."""
    linear, offset = exposures.matrices[:, :, :3], exposures.matrices[:, :, 3]
    count = int(samples.point.max()) + 1 if len(samples) else 0
    normal = _summed(weights[:, None, None] * (linear.mT @ linear)[samples.view], samples.point, count)
    left = (linear.mT[samples.view] @ (samples.colour - offset[samples.view])[:, :, None])[:, :, 0]
    right = _summed(weights[:, None] * left, samples.point, count)
    return torch.linalg.solve(normal + 1e-12 * torch.eye(3, dtype=normal.dtype), right)


def _applied(matrices: Float[Tensor, "n 3 4"], colours: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return (matrices[:, :, :3] @ colours[:, :, None])[:, :, 0] + matrices[:, :, 3]


def _summed(parts: Float[Tensor, "n *rest"], group: Tensor, groups: int) -> Float[Tensor, "groups *rest"]:
    """The sum of the parts of each group."""
    return parts.new_zeros(groups, *parts.shape[1:]).index_add_(0, group, parts)
