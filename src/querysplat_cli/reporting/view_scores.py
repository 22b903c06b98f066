"""PSNR and SSIM of renders against photos."""

from dataclasses import dataclass

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import psnr, ssim_metric


@dataclass(frozen=True)
class Quality:
    """PSNR (dB) and SSIM: means over the views, and view by view, at the working resolution.

    Renders are clipped to [0, 1]; only pixels inside the views' masks count.
    """

    psnr: float
    ssim: float
    views: dict[str, dict[str, float]]

    def summary(self) -> dict[str, float]:
        return {"psnr": round(self.psnr, 3), "ssim": round(self.ssim, 4)}


def score(gaussians: Gaussians, views: Views, cameras: Cameras, background: float = 0.0) -> Quality:
    """Render each view over a grey `background` in [0, 1], and compare it with its photo."""
    rows, grey = {}, torch.full((3,), background)
    with torch.no_grad():
        for i, (name, (height, width)) in enumerate(zip(views.names, views.sizes, strict=True)):
            picture = render(gaussians, cameras[[i]], background=grey).colour[0].clamp(0, 1)[:, :height, :width]
            photo = views.picture(i)[:, :height, :width]
            mask = views.masks[i][:height, :width]
            rows[name] = {
                "psnr": float(psnr(picture, photo, mask)),
                "ssim": float(ssim_metric(torch.where(mask, picture, photo), photo)),
            }
    mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in ("psnr", "ssim")}
    return Quality(mean["psnr"], mean["ssim"], rows)
