"""Colour transforms of photos that follow the scene while it is optimised."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.splat.render import Rendering
from querysplat_cli.tto.exposure_fit import solve
from querysplat_cli.tto.exposure_policy import EXPOSURE_POLICY


class RefittedExposures:
    """Transforms that follow the scene while it is optimised. They are fitted to the renders that its steps make."""

    def __init__(self, start: Exposures) -> None:
        self.current = start
        views = len(start)
        self._normal = start.matrices.new_zeros(views, 4, 4)
        self._right = start.matrices.new_zeros(views, 4, 3)
        self._weight = start.matrices.new_zeros(views)

    def copy(self) -> "RefittedExposures":
        """What there is now, for `go_back`."""
        found = RefittedExposures(self.current)
        found.go_back(self)
        return found

    def go_back(self, earlier: "RefittedExposures") -> None:
        """Be as a copy was."""
        self.current = earlier.current
        self._normal, self._right, self._weight = (
            part.clone() for part in (earlier._normal, earlier._right, earlier._weight)
        )

    def exposed(self, rendering: Rendering, view: int) -> Rendering:
        """A render of one view over black, in the colours of its photo.

        Its colour C, times alpha α, becomes M·C + α·b. This is the render of the scene whose Gaussians have the
        transformed colours. The background behind it is not transformed: a darker photo must not make it cheaper to be
        transparent, and an offset must not colour what is empty.
        """
        matrix = self.current.matrices[view].to(rendering.colour)
        linear = torch.einsum("ij,vjhw->vihw", matrix[:, :3], rendering.colour)
        return replace(rendering, colour=linear + matrix[:, 3, None, None] * rendering.alpha[:, None])

    @torch.no_grad()
    def refit(
        self,
        view: int,
        rendering: Rendering,
        photo: Float[Tensor, "3 height width"],
        mask: Bool[Tensor, "height width"],
    ) -> None:
        """Bring the transform of a view closer to what its photo shows.

        `rendering` is over black, in the colours of the scene.

        Colour and photo are both taken times alpha. Pixels that the scene leaves empty do not count.
        """
        policy = EXPOSURE_POLICY
        grid = (slice(policy.every_pixel // 2, None, policy.every_pixel),) * 2
        opaque = rendering.alpha[0][grid].flatten().double()
        shown = photo[(slice(None), *grid)].flatten(1).double()
        known = torch.cat([rendering.colour[0][(slice(None), *grid)].flatten(1).double(), opaque[None]])
        error = (self.current.matrices[view].to(known) @ known - shown * opaque).norm(dim=0)
        usable = mask[grid].flatten() & (shown.amax(0) < policy.saturated)
        weights = usable / (error + policy.error_floor)
        heavy = weights * known
        total = weights.sum().clamp_min(1e-9)
        for kept, new in (
            (self._normal, heavy @ known.mT / total),
            (self._right, heavy @ (shown * opaque).mT / total),
            (self._weight, (weights.sum() > 0).double()),
        ):
            kept[view] = policy.memory * kept[view] + (1 - policy.memory) * new.to(kept)
        fitted = solve(self._normal[view], self._right[view], self._weight[view])
        matrices = self.current.matrices.clone()
        matrices[view] += policy.pace * (fitted - matrices[view])
        self.current = Exposures(matrices).with_identity_mean()
