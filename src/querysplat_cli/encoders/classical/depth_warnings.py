"""A warning about a few photos that hardly agree on depth, whatever their matches say of the cameras."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.patch_features import PATCH
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.find_pixels import find_pixels


def depth_warnings(
    posed: PosedViews, depth: Float[Tensor, "views height width"], confidence: Float[Tensor, "views height width"]
) -> tuple[str, ...]:
    """A sentence where two to `few_photos` photos agree on the depth of little of what they share.

    So few may have cameras that fit their matches and nothing else.
    """
    if not 2 <= len(posed.views) <= CAMERA_POLICY.few_photos:
        return ()
    share = agreeing_share(posed, depth, confidence)
    if share >= DEPTH_POLICY.agreeing_share:
        return ()
    advice = "photos from places closer together help"
    return (f"the photos agree on the depth of only {share:.0%} of what they share, so it may look smeared; {advice}",)


def agreeing_share(
    posed: PosedViews, depth: Float[Tensor, "views height width"], confidence: Float[Tensor, "views height width"]
) -> float:
    """The share of measured depth in what another photo shows, too, looked up in the middle of every patch.

    1 where no photo shows what another one does.
    """
    middle = slice(PATCH // 2, None, PATCH)
    inside, sure = (
        part[:, middle, middle] for part in (posed.views.masks, confidence > DEPTH_POLICY.measured_confidence)
    )
    shared = torch.zeros_like(inside)
    for own, places in enumerate(posed.cameras.patch_places(depth, PATCH)):
        for other in set(range(len(inside))) - {own}:
            seen = find_pixels(places.flatten(0, 1), other, posed.views, posed.cameras)[0]
            shared[own] |= seen.view(places.shape[:2])
    shared &= inside
    return float(sure[shared].float().mean()) if shared.any() else 1.0
