"""What `convert` leaves out of a scene on request, and what each step costs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.commands.compared_views import ComparedViews
from querysplat_cli.commands.convert_request import Conversion
from querysplat_cli.prune.clean import unclean
from querysplat_cli.prune.gaussians import importance
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import Gaussians

Mask = Bool[Tensor, "n"]


@dataclass(frozen=True)
class Step:
    """One step: its option, the Gaussians that stay after it, and the PSNR (dB) on the compared views.

    counts: of those that went, by reason, where the step has several.
    """

    what: str
    gone: int
    psnr: float
    counts: dict[str, int] = field(default_factory=dict)

    def entry(self, before: float) -> dict[str, Any]:
        """For the result. `before` is the PSNR before the step."""
        lost = round(before - self.psnr, 3)
        return {"what": self.what, "gaussians": self.gone, **self.counts, "psnr": round(self.psnr, 3), "lost": lost}


def edited(
    request: Conversion, here: Gaussians, places: Float[Tensor, "n 3"], backdrop: int, views: ComparedViews
) -> tuple[Mask, list[Step]]:
    """Which of the Gaussians `here`, in the frame of `views`, stay after all that `request` asks for.

    `places` are their centres in the target. The last ones, as many as `backdrop`, are the backdrop: cleaning and
    --prune leave it alone. Raises QuerySplatError when a step leaves none.
    """
    kept = torch.ones(len(here), dtype=torch.bool)
    steps: list[Step] = []
    for what, find in _finders(request, places, backdrop, views):
        gone, counts = find(here, kept)
        gone = gone & kept
        kept = kept & ~gone
        if not kept.any():
            raise QuerySplatError(f"--{what} leaves no Gaussian", "Boxes and spheres are in the axes of the result.")
        steps.append(Step(what, int(gone.sum()), views.psnr(here[kept]), counts))
    return kept, steps


Find = Callable[[Gaussians, Mask], tuple[Mask, dict[str, int]]]


def _finders(
    request: Conversion, places: Float[Tensor, "n 3"], backdrop: int, views: ComparedViews
) -> Iterator[tuple[str, Find]]:
    body = torch.arange(len(places)) < len(places) - backdrop
    if request.clean:
        yield "clean", lambda here, kept: _dirt(here, kept & body, views)
    if request.no_backdrop:
        yield "no-backdrop", lambda here, kept: (~body, {})
    if request.crop:
        crop = ~inside_box(request.crop, places)
        yield "crop", lambda here, kept: (crop, {})
    if request.remove:
        inside = inside_box(request.remove, places)
        yield "remove", lambda here, kept: (inside, {})
    if request.keep_sphere:
        centre, radius = places.new_tensor(request.keep_sphere[:3]), request.keep_sphere[3]
        outside = (places - centre).norm(dim=1) > radius
        yield "keep-sphere", lambda here, kept: (outside, {})
    if request.prune_to:
        most = request.prune_to
        yield "prune", lambda here, kept: (_least(here, kept, kept & body, most, views), {})


def _dirt(here: Gaussians, chosen: Mask, views: ComparedViews) -> tuple[Mask, dict[str, int]]:
    gone = torch.zeros_like(chosen)
    if not chosen.any():
        return gone, {}
    found = unclean(here[chosen], None if views.kind == "orbit" else views.judges)
    gone[chosen] = found.all
    return gone, found.counts()


def _least(here: Gaussians, kept: Mask, chosen: Mask, most: int, views: ComparedViews) -> Mask:
    """The Gaussians beyond the `most` important ones. The backdrop counts, but goes last."""
    value = importance(here[kept], views.judges)
    value[~chosen[kept]] = torch.inf
    order = value.argsort(descending=True, stable=True)
    gone = torch.zeros_like(kept)
    gone[torch.nonzero(kept)[:, 0][order[most:]]] = True
    return gone


def inside_box(box: tuple[float, ...], places: Float[Tensor, "n 3"]) -> Mask:
    """Which places lie in the box (x0, y0, z0, x1, y1, z1), its faces included."""
    low, high = places.new_tensor(box).reshape(2, 3)
    return ((places >= low) & (places <= high)).all(1)
