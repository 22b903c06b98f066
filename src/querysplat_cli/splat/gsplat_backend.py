"""gsplat's CUDA rasteriser behind the same call: the optional part `querysplat[cuda]`."""

from typing import Any

import torch
from torch import Tensor

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.conventions import RenderSettings


def blend(gaussians: Gaussians, cameras: Cameras, settings: RenderSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Colour on black, alpha, and Σ w·z of every view. gsplat's own alpha limits apply (RenderSettings)."""
    rasterization = _gsplat()
    cameras = cameras.to(gaussians.means.device).to(torch.float32)
    pictures, alpha, _ = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=gaussians.sh,
        viewmats=cameras.w2c,
        Ks=cameras.K,
        width=cameras.width,
        height=cameras.height,
        near_plane=settings.near,
        far_plane=settings.far,
        eps2d=settings.low_pass,
        sh_degree=gaussians.sh_degree,
        packed=False,
        render_mode="RGB+D",
    )
    pictures = pictures.permute(0, 3, 1, 2)
    return pictures[:, :3], alpha[..., 0], pictures[:, 3]


def _gsplat() -> Any:
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise MissingPart("rendering on a GPU needs gsplat", f"Run `{install_command('cuda')}`.") from error
    if not torch.cuda.is_available():
        raise MissingPart("gsplat needs a CUDA device, and there is none", "Use --device cpu.")
    return rasterization
