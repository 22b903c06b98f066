"""Rendering errors of a scene against the input photos, attributed to the Gaussians that cause them.

A decoder that reads them corrects in one pass what would take optimisation many steps. Nothing is optimised here,
and only input views are used.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.attribution import attribute


@dataclass(frozen=True)
class Comparison:
    """A scene beside the input photos.

    errors: for each Gaussian, see `compare`.
    residual: photo minus rendering, 0 outside of the masks.
    alpha, depth: those of the rendering.
    """

    errors: Float[Tensor, "n 11"]
    residual: Float[Tensor, "views 3 height width"]
    alpha: Float[Tensor, "views height width"]
    depth: Float[Tensor, "views height width"]


def with_rendering_error(anchors: Anchors, views: Views, cameras: Cameras) -> Anchors:
    """The same anchors, with the rendering error of their prior on black appended to their features."""
    error = compare(prior_gaussians(anchors), views, cameras).errors.reshape(len(anchors), -1)
    return replace(anchors, features=torch.cat([anchors.features, error], 1))


def prior_gaussians(anchors: Anchors) -> Gaussians:
    """The scene that the anchors describe before any decoder changes it."""
    return Gaussians(
        means=anchors.means.flatten(0, 1),
        quats=anchors.quats.flatten(0, 1),
        scales=anchors.scales.flatten(0, 1),
        opacities=anchors.opacities.flatten(),
        sh=((anchors.colours.flatten(0, 1) - 0.5) / SH_0)[:, None],
    )


def error_gains() -> Float[Tensor, "10"]:
    """The factor of each slope, in the order of the errors of `compare`."""
    policy = QUERY_POLICY
    return torch.tensor([policy.colour_gain] * 3 + [policy.opacity_gain] + [policy.shape_gain] * 6)


def compare(gaussians: Gaussians, views: Views, cameras: Cameras, grey: float = 0.0) -> Comparison:
    """The scene rendered over a grey background into all views, and the error of each Gaussian.

    The errors are the descent directions of half the squared error, each per pixel that the Gaussian colours: colour 3,
    opacity, centre along its own axes 3, size along them 3. Lengths are in units of its own axes, sizes in logarithms,
    opacity in logits. They are multiplied by the gains of the policy and clamped. The last number is the logarithm of
    the Gaussian's pixels.
    """
    gaussians = gaussians.detach()
    background = views.images.new_full((3,), grey)
    descent, pixels = gaussians.map(torch.zeros_like), torch.zeros_like(gaussians.opacities)
    seen = []
    for view in range(len(views)):
        found = attribute(gaussians, cameras[[view]], views.images[view], views.masks[view], background)
        for total, part in zip(descent.tensors(), found.descent.tensors(), strict=True):
            total += part
        pixels += found.weights
        seen.append((found.residual, found.picture.alpha[0], found.picture.depth[0]))
    errors = _along_own_axes(gaussians, descent) / (pixels[:, None] + 1)
    limit = QUERY_POLICY.largest_error
    clamped = (error_gains().to(errors) * errors).clamp(-limit, limit)
    residual, alpha, depth = (torch.stack(part) for part in zip(*seen, strict=True))
    return Comparison(torch.cat([clamped, (pixels[:, None] + 1).log() / 4], 1), residual, alpha, depth)


def _along_own_axes(gaussians: Gaussians, descent: Gaussians) -> Float[Tensor, "n 10"]:
    """Derivatives by colour, opacity (logit), centre (own axes, in units of the sizes) and size (logarithm)."""
    axes = quaternion_to_matrix(F.normalize(gaussians.quats, dim=1))
    opacities = gaussians.opacities
    return torch.cat(
        [
            descent.sh[:, 0] / SH_0,
            (descent.opacities * opacities * (1 - opacities))[:, None],
            (descent.means[:, None] @ axes)[:, 0] * gaussians.scales,
            descent.scales * gaussians.scales,
        ],
        1,
    )
