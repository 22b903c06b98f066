"""Gaussians and cameras in, pictures out: the one public entry of the splatter."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.registry import Registry
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.conventions import RenderSettings

__all__ = ["RenderSettings", "Rendering", "render"]

Blend = Callable[[Gaussians, Cameras, RenderSettings], tuple[Tensor, Tensor, Tensor]]
BACKENDS = Registry(
    "splatter",
    "querysplat.splatters",
    {
        "reference": "querysplat_cli.splat.reference:blend",
        "cpu": "querysplat_cli.splat.cpu:blend",
        "gsplat": "querysplat_cli.splat.gsplat_backend:blend",
    },
)
"""Functions `blend` by the name of their splatter."""


@dataclass(frozen=True)
class Rendering:
    """Pictures of every view. `colour` is not clamped; `depth` is the expected camera z, 0 where alpha is 0."""

    colour: Float[Tensor, "views 3 height width"]
    alpha: Float[Tensor, "views height width"]
    depth: Float[Tensor, "views height width"]

    @staticmethod
    def of(colour: Tensor, alpha: Tensor, weighted_depth: Tensor, background: Float[Tensor, "3"] | None) -> "Rendering":
        """What a splatter blends on black, over a background."""
        black = Rendering(colour, alpha, weighted_depth / alpha.clamp_min(1e-10))
        return replace(black, colour=black.over(background))

    def over(self, background: Float[Tensor, "3"] | None) -> Float[Tensor, "views 3 height width"]:
        """The colour over another background, where this is rendered over black."""
        if background is None:
            return self.colour
        return self.colour + (1 - self.alpha[:, None]) * background.to(self.colour)[:, None, None]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Float[Tensor, "3"] | None = None,
    settings: RenderSettings | None = None,
    backend: str = "auto",
) -> Rendering:
    """Splat the Gaussians into every view, differentiably in all their parameters and in the cameras' w2c and K.

    `background` is the colour behind them, black by default. `backend` "auto" takes gsplat for CUDA
    tensors, the plain torch reference for float64, and the compiled CPU kernel otherwise. Raises
    QuerySplatError when a tensor holds NaN or Inf, and MissingPart when the backend is not there.
    """
    refuse_broken(gaussians, cameras)
    blend: Blend = BACKENDS.find(usual_splatter(gaussians) if backend == "auto" else backend)
    return Rendering.of(*blend(gaussians, cameras, settings or RenderSettings()), background)


def register_splatter(name: str, blend: Blend) -> None:
    """Let `render(…, backend=name)` call `blend(gaussians, cameras, settings)`, in this process.

    For every view it returns the colour on black [views, 3, height, width], the coverage α [views, height, width], and
    Σ w·z of the same shape. Raises QuerySplatError where the name is taken.
    """
    BACKENDS.register(name, blend)


def usual_splatter(gaussians: Gaussians) -> str:
    """What the backend "auto" stands for."""
    if gaussians.means.is_cuda:
        return "gsplat"
    return "reference" if gaussians.means.dtype == torch.float64 else "cpu"


def refuse_broken(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raises QuerySplatError where tensors do not fit together, and where one holds NaN or Inf."""
    _refuse_wrong_shapes(gaussians)
    _refuse_non_finite(gaussians.named())
    _refuse_non_finite({"w2c": cameras.w2c, "K": cameras.K})


def _refuse_wrong_shapes(gaussians: Gaussians) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.named().items()}
    n = len(gaussians)
    bands = shapes["sh"][1] if len(shapes["sh"]) == 3 else 0
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, bands, 3)}
    if shapes != expected or bands not in (1, 4, 9, 16):
        found = ", ".join(f"{name} {list(shape)}" for name, shape in shapes.items())
        raise QuerySplatError(
            f"the tensors of these Gaussians do not fit together: {found}",
            "Give n × 3 means, n × 4 quats, n × 3 scales, n opacities, and n × 1, 4, 9 or 16 × 3 sh.",
        )


def _refuse_non_finite(tensors: dict[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if not all_finite(tensor):
            wrong = ~tensor.isfinite()
            raise QuerySplatError(
                f"{int(wrong.sum())} of the {tensor.numel()} numbers in `{name}` are NaN or infinite, "
                f"the first at {wrong.nonzero()[0].tolist()}",
                "Remove those Gaussians or cameras, or find out what made them.",
            )


def all_finite(tensor: Tensor) -> bool:
    """Whether a tensor holds neither NaN nor Inf.

    A sum is finite only if every summand is. Where it is not, it may have overflowed, and the numbers are looked at.
    """
    return bool(tensor.detach().sum().isfinite()) or bool(tensor.isfinite().all())
