"""Rendering errors of the prior against the input photos, attributed to the Gaussians that cause them.

A decoder that reads them corrects in one pass what would take optimisation many steps. Nothing is optimised here,
and only input views are used.
"""

from dataclasses import replace

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

ERROR_CHANNELS = 11
"""Numbers for each Gaussian: colour 3, opacity, centre along its own axes 3, size along them 3, pixels."""


def with_rendering_error(anchors: Anchors, views: Views, cameras: Cameras) -> Anchors:
    """The same anchors, with the rendering error of their prior appended to their features."""
    error = rendering_error(prior_gaussians(anchors), views, cameras).reshape(len(anchors), -1)
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
    """The factor of each slope, in the order of `ERROR_CHANNELS`."""
    policy = QUERY_POLICY
    return torch.tensor([policy.colour_gain] * 3 + [policy.opacity_gain] + [policy.shape_gain] * 6)


def rendering_error(gaussians: Gaussians, views: Views, cameras: Cameras) -> Float[Tensor, "n 11"]:
    """For each Gaussian, the descent directions of half the squared error, each per pixel that it colours.

    Lengths are in units of its own axes, sizes in logarithms, opacity in logits. They are multiplied by the gains of
    the policy and clamped. The last number is the logarithm of the Gaussian's pixels.
    """
    shape = {"move": (len(gaussians), 3), "grow": (len(gaussians), 3), "fade": (len(gaussians),)}
    change = {name: torch.zeros(size).requires_grad_() for name, size in shape.items()}
    colour = gaussians.sh.detach()[:, :1].clone().requires_grad_()
    axes = quaternion_to_matrix(F.normalize(gaussians.quats, dim=1))
    with torch.enable_grad():
        for view in range(len(views)):
            moved = Gaussians(
                means=gaussians.means + (axes @ (change["move"] * gaussians.scales)[..., None])[..., 0],
                quats=gaussians.quats,
                scales=gaussians.scales * change["grow"].exp(),
                opacities=torch.sigmoid(torch.logit(gaussians.opacities, eps=1e-6) + change["fade"]),
                sh=torch.cat([colour, gaussians.sh[:, 1:]], 1),
            )
            picture = render(moved, cameras[[view]]).colour[0]
            error = (views.images[view] - picture.detach()) * views.masks[view]
            (picture * error).sum().backward()
    pixels = blending_weights(gaussians, cameras)[:, None]
    given = [colour.grad, change["fade"].grad, change["move"].grad, change["grow"].grad]
    slopes = torch.cat([torch.zeros(0) if each is None else each.reshape(len(gaussians), -1) for each in given], 1)
    slopes = torch.cat([slopes[:, :3] / SH_0, slopes[:, 3:]], 1) / (pixels + 1)
    limit = QUERY_POLICY.largest_error
    return torch.cat([(error_gains() * slopes).clamp(-limit, limit), (pixels + 1).log() / 4], 1)
