"""Dropout of Gaussians between a few photos, as in DropGaussian (Park et al. 2025, arXiv:2504.00773)."""

from dataclasses import replace

import torch

from querysplat_cli.scene.gaussians import Gaussians

HIGHEST_OPACITY = 0.99


def without_some(gaussians: Gaussians, share: float, generator: torch.Generator) -> Gaussians:
    """All Gaussians, of which a random `share` is transparent; the others' opacities make up for it on the mean.

    Gaussians that lie in front of others in every photo keep these from any gradient. Without them for a step, those
    behind learn as well. Differentiable in the opacities.
    """
    kept = torch.rand(len(gaussians), generator=generator) >= share
    opacities = gaussians.opacities * kept.to(gaussians.opacities) / (1 - share)
    return replace(gaussians, opacities=opacities.clamp(max=HIGHEST_OPACITY))
