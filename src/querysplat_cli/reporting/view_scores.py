"""PSNR and SSIM of renders against photos."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.colour_correction import channel_corrected, left_half, matrix_corrected
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import limited_psnr, ssim_metric

DIGITS = {"psnr": 3, "ssim": 4, "psnr_grey": 3, "psnr_cc": 3, "ssim_cc": 4, "psnr_half": 3}
"""The scores of a view, and how many digits of them a summary shows."""


@dataclass(frozen=True)
class Quality:
    """PSNR (dB, at most `EQUAL_PSNR`) and SSIM: means over the views, and view by view, at the size of the views.

    Renders are clipped to [0, 1]. Only pixels inside the views' masks count. `background` is the grey level behind the
    scene. `psnr_grey` is the PSNR over mid-grey: where it is lower than that over black, the scene is see-through.

    The other scores leave the exposure of the photo out. `psnr_cc` and `ssim_cc` are of the renders over `background`
    whose channels are mapped to the photo's, each by a slope and an offset (as gsplat's trainer scores). `psnr_half` is
    that of the right half of the picture, after the 3 × 4 transform that fits its left half best (as Inria's code
    scores scenes with exposure correction).
    """

    psnr: float
    ssim: float
    psnr_grey: float
    psnr_cc: float
    ssim_cc: float
    psnr_half: float
    background: float
    views: dict[str, dict[str, float]]

    @classmethod
    def of_views(cls, rows: dict[str, dict[str, float]], background: float) -> "Quality":
        """The scores of views by name."""
        mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in DIGITS}
        return cls(**mean, background=background, views=rows)

    @classmethod
    def together(cls, parts: Sequence["Quality"]) -> "Quality":
        """The scores of all views of `parts`, which have one background."""
        return cls.of_views({name: row for part in parts for name, row in part.views.items()}, parts[0].background)

    def of(self, names: Iterable[str]) -> "Quality":
        """The scores of the views with these names alone."""
        return Quality.of_views({name: self.views[name] for name in names}, self.background)

    def summary(self) -> dict[str, float]:
        return {name: round(getattr(self, name), digits) for name, digits in DIGITS.items()}


def score(gaussians: Gaussians, views: Views, cameras: Cameras, background: float = 0.0) -> Quality:
    """Render each view over a grey `background` in [0, 1], and compare it with its photo."""
    rows = {}
    with torch.no_grad():
        for i, (name, (height, width)) in enumerate(zip(views.names, views.sizes, strict=True)):
            drawn = render(gaussians, cameras[[i]])
            over = {
                level: drawn.over(torch.full((3,), level))[0].clamp(0, 1)[:, :height, :width]
                for level in {background, MID_GREY}
            }
            picture = over[background]
            photo = views.picture(i)[:, :height, :width]
            mask = views.masks[i][:height, :width]
            rows[name] = {
                "psnr": limited_psnr(picture, photo, mask),
                "ssim": ssim_metric(picture, photo, mask),
                "psnr_grey": limited_psnr(over[MID_GREY], photo, mask),
                **_corrected_scores(picture, photo, mask),
            }
    return Quality.of_views(rows, background)


def _corrected_scores(
    picture: Float[Tensor, "3 height width"], photo: Float[Tensor, "3 height width"], mask: Bool[Tensor, "height width"]
) -> dict[str, float]:
    corrected, left = channel_corrected(picture, photo, mask), left_half(mask)
    right = mask & ~left
    return {
        "psnr_cc": limited_psnr(corrected, photo, mask),
        "ssim_cc": ssim_metric(corrected, photo, mask),
        "psnr_half": limited_psnr(matrix_corrected(picture, photo, left), photo, right if right.any() else mask),
    }
