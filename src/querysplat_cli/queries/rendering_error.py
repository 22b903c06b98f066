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
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.render import render


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
    gaussians = gaussians.map(Tensor.detach)
    change = _Change.none(gaussians)
    axes = quaternion_to_matrix(F.normalize(gaussians.quats, dim=1))
    background = views.images.new_full((3,), grey) if grey else None
    pictures = []
    with torch.enable_grad():
        for view in range(len(views)):
            picture = render(change.of(gaussians, axes), cameras[[view]], background=background)
            residual = (views.images[view] - picture.colour[0].detach()) * views.masks[view]
            (picture.colour[0] * residual).sum().backward()
            pictures.append((residual, picture.alpha[0].detach(), picture.depth[0].detach()))
    pixels = blending_weights(gaussians, cameras)[:, None]
    slopes = change.slopes() / (pixels + 1)
    limit = QUERY_POLICY.largest_error
    errors = torch.cat([(error_gains().to(slopes) * slopes).clamp(-limit, limit), (pixels + 1).log() / 4], 1)
    residual, alpha, depth = (torch.stack(part) for part in zip(*pictures, strict=True))
    return Comparison(errors, residual, alpha, depth)


@dataclass(frozen=True)
class _Change:
    """Variables that change every Gaussian: its colour, opacity (logits), centre (own axes) and log-size."""

    colour: Float[Tensor, "n 1 3"]
    fade: Float[Tensor, "n"]
    move: Float[Tensor, "n 3"]
    grow: Float[Tensor, "n 3"]

    @staticmethod
    def none(gaussians: Gaussians) -> "_Change":
        zeros = gaussians.means.new_zeros
        n = len(gaussians)
        start = gaussians.sh[:, :1].clone(), zeros(n), zeros(n, 3), zeros(n, 3)
        return _Change(*(part.requires_grad_() for part in start))

    def of(self, gaussians: Gaussians, axes: Float[Tensor, "n 3 3"]) -> Gaussians:
        return Gaussians(
            means=gaussians.means + (axes @ (self.move * gaussians.scales)[..., None])[..., 0],
            quats=gaussians.quats,
            scales=gaussians.scales * self.grow.exp(),
            opacities=torch.sigmoid(torch.logit(gaussians.opacities, eps=1e-6) + self.fade),
            sh=torch.cat([self.colour, gaussians.sh[:, 1:]], 1),
        )

    def slopes(self) -> Float[Tensor, "n 10"]:
        parts = self.colour, self.fade, self.move, self.grow
        given = [torch.zeros_like(part) if part.grad is None else part.grad for part in parts]
        colour, *others = (each.reshape(len(self.fade), -1) for each in given)
        return torch.cat([colour / SH_0, *others], 1)
