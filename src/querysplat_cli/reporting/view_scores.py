"""PSNR and SSIM of renders against photos."""

from dataclasses import dataclass

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import psnr, ssim_metric


@dataclass(frozen=True)
class Quality:
    """PSNR (dB) and SSIM: means over the views, and view by view, at the size of the views.

    Renders are clipped to [0, 1]. Only pixels inside the views' masks count. `background` is the grey level behind the
    scene. `psnr_grey` is the PSNR over mid-grey: where it is lower than that over black, the scene is see-through.
    """

    psnr: float
    ssim: float
    psnr_grey: float
    background: float
    views: dict[str, dict[str, float]]

    def summary(self) -> dict[str, float]:
        return {"psnr": round(self.psnr, 3), "ssim": round(self.ssim, 4), "psnr_grey": round(self.psnr_grey, 3)}


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
                "psnr": float(psnr(picture, photo, mask)),
                "ssim": float(ssim_metric(torch.where(mask, picture, photo), photo)),
                "psnr_grey": float(psnr(over[MID_GREY], photo, mask)),
            }
    mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in ("psnr", "ssim", "psnr_grey")}
    return Quality(**mean, background=background, views=rows)
