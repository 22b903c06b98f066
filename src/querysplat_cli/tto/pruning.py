"""Pruning during test-time optimisation: what it costs is measured on a few of the input views."""

from functools import partial
from typing import Literal

from querysplat_cli.prune.gaussians import Pruned, prune
from querysplat_cli.prune.hiding import hiding
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.options import Pruning
from querysplat_cli.tto.rendering_loss import RenderingLoss


def pruning_to(amount: Amount, views: int) -> Pruning | None:
    """A callback that prunes to `amount`, for a target of so many views; None where all Gaussians stay."""
    return None if amount == "off" else partial(_prune, amount, tested_views(views))


def tested_views(views: int) -> list[int]:
    """The views that the cost of leaving something out is measured on."""
    return evenly_spaced(range(views), PRUNE_POLICY.tested_views)


def _prune(
    amount: Literal["auto"] | int, tested: list[int], gaussians: Gaussians, target: RenderingLoss, steps_left: float
) -> Pruned:
    """An automatic amount leaves out, too, what hides far more beside the photos than it shows in them."""
    found = prune(gaussians, target.cameras, amount, lambda some: target.psnr(some, tested), steps_left)
    if amount != "auto":
        return found
    kept = found.kept.clone()
    kept[found.kept] = ~hiding(gaussians[found.kept], target.cameras, target.views.sizes, harm=PRUNE_POLICY.harm)
    return Pruned(kept, found.psnr_before, target.psnr(gaussians[kept], tested))
