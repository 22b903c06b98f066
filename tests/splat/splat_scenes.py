"""The comparison of a picture and its gradients with the float64 reference."""

from dataclasses import dataclass

import torch
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import Rendering, RenderSettings, render
from scenes import FIELDS

BACKENDS = ("reference", "cpu")


@dataclass(frozen=True)
class Outcome:
    rendering: Rendering
    gradients: dict[str, Tensor]


def outcome(
    gaussians: Gaussians,
    cameras: Cameras,
    backend: str,
    *,
    depth: bool = True,
    settings: RenderSettings | None = None,
) -> Outcome:
    """Picture and gradients of a random linear functional of colour, alpha and, if asked for, depth.

    The depth of a single Gaussian is z whatever its α, so that the gradient of depth is a difference of equal numbers.
    No float32 arithmetic computes it well, and scenes of one Gaussian leave it out.
    """
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = gaussians.detach().map(lambda field: field.to(dtype).clone().requires_grad_())
    result = render(leaves, cameras, backend=backend, settings=settings)
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=dtype)
    for picture in (result.colour, result.alpha, result.depth)[: 3 if depth else 2]:
        loss = loss + (picture * torch.randn(picture.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
    slopes = torch.autograd.grad(loss, [getattr(leaves, name) for name in FIELDS])
    return Outcome(
        Rendering(result.colour.detach(), result.alpha.detach(), result.depth.detach()),
        dict(zip(FIELDS, slopes, strict=True)),
    )


def as_kernel_sees(gaussians: Gaussians) -> Gaussians:
    """Rounded to float32 and back, so that the comparison is of arithmetic and not of the inputs' rounding."""
    return gaussians.to(torch.float32).to(torch.float64)


def assert_agree(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    settings: RenderSettings | None = None,
    image: float = 1e-5,
    gradient: float = 1e-4,
    flips: float = 0.0,
    depth: bool = True,
) -> None:
    """Kernel and float64 reference: colour and alpha within `image`, each gradient within `gradient`.

    Depth is held relative to the far end of the scene. Gradients are held as a whole (relative L2), in
    direction (cosine), and each number to 100 × `gradient` of the largest of its field, so that a missing
    part cannot hide. `flips` is the share of pixels that may differ by up to two steps of 1/255, because an
    alpha at the cut-off falls to one side or the other.
    """
    gaussians = as_kernel_sees(gaussians)
    fast = outcome(gaussians, cameras, "cpu", depth=depth, settings=settings)
    exact = outcome(gaussians, cameras, "reference", depth=depth, settings=settings)
    for name, scale in (("colour", 1.0), ("alpha", 1.0), ("depth", float(exact.rendering.depth.max().clamp_min(1)))):
        difference = (getattr(fast.rendering, name) - getattr(exact.rendering, name)).abs() / scale
        assert difference.isfinite().all(), name
        outside = difference > image
        assert outside.double().mean() <= flips, f"{name}: {float(difference.max()):.2e}"
        assert difference.max() <= (2 / 255 if flips else image), name
    for name in FIELDS:
        close_gradients(fast.gradients[name].double(), exact.gradients[name], gradient, name)


def close_gradients(found: Tensor, exact: Tensor, tolerance: float, name: str) -> None:
    assert found.isfinite().all(), name
    size = exact.norm()
    if size == 0:
        assert found.abs().max() == 0, name
        return
    relative = float((found - exact).norm() / size)
    assert relative <= tolerance, f"{name}: relative L2 error {relative:.2e}"
    assert float((found * exact).sum() / (found.norm() * size)) >= 1 - tolerance, name
    worst = float((found - exact).abs().max() / exact.abs().max())
    assert worst <= 100 * tolerance, f"{name}: worst element {worst:.2e} of the largest"


def all_finite(gaussians: Gaussians, cameras: Cameras, backend: str) -> Tensor:
    """The colour, after checking that it and every gradient are finite."""
    found = outcome(gaussians, cameras, backend)
    for picture in (found.rendering.colour, found.rendering.alpha, found.rendering.depth):
        assert picture.isfinite().all()
    for name, gradient in found.gradients.items():
        assert gradient.isfinite().all(), name
    return found.rendering.colour


def assert_culled(gaussians: Gaussians, cameras: Cameras, backend: str) -> None:
    found = outcome(gaussians, cameras, backend)
    assert found.rendering.alpha.max() == 0
    for name, gradient in found.gradients.items():
        assert gradient.abs().max() == 0, name
