"""The rendering loss of many views, and its gradient, in the memory of a few."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.backdrop import shows_background
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.lpips import Perceptual, perceptual_loss
from querysplat_cli.splat.render import Rendering, RenderSettings, render
from querysplat_cli.splat.similarity import SSIM_WEIGHT, photometric_loss, photometric_value
from querysplat_cli.tto.exposure_policy import EXPOSURE_POLICY
from querysplat_cli.tto.exposure_refit import RefittedExposures
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.smooth_depth import depth_roughness


@dataclass(frozen=True)
class LossAndGradient:
    """The loss of each view, the mean PSNR in dB, and the gradient of the mean loss.

    `gradient` is with respect to the Gaussians, `camera_gradient` with respect to w2c and K of all views (None where
    the cameras require no gradient).
    """

    losses: list[float]
    psnr: float
    gradient: Gaussians
    camera_gradient: tuple[Tensor, Tensor] | None = None

    @property
    def loss(self) -> float:
        return sum(self.losses) / len(self.losses)

    def send_back(self, gaussians: Gaussians, cameras: Cameras) -> None:
        """Propagate the gradient to what `gaussians` were made from, and `cameras` where they require it."""
        made, slopes = gaussians.tensors(), self.gradient.tensors()
        if self.camera_gradient:
            made += [cameras.w2c, cameras.K]
            slopes += self.camera_gradient
        torch.autograd.backward(made, slopes)


@dataclass(frozen=True)
class RenderingLoss:
    """L1 + 0.2·D-SSIM + 0.05·LPIPS between renders and photos (paper, section 3.4), without LPIPS where it is None.

    The loss of a set of views is the mean of the views' losses. Views are rendered one after another, and their
    gradients with respect to the Gaussians are added up, so that memory does not grow with the number of views.

    background: behind the scene (None: black).
    backgrounds: draws the colour of every gradient, so that the scene cannot use the background as its own
        colour. Values, which are compared with each other, have the one `background`.
    exposures: transforms from the scene's colours to those of each photo (None: they are the same). They are refitted
        to every render that a gradient is taken of.
    finest: cameras that bound how thin and how large optimisation may make a Gaussian (`tto/scale_bounds.py`; None:
        nothing bounds that).
    perceptual: LPIPS with its weights (None: it is left out).
    halved: share of the gradients that have, beside the views, the same ones at half of the size, by `TtoPolicy.half`;
        `backgrounds` draws them. Gaussians smaller than a pixel are drawn larger than they are, so that a scene of many
        has other colours from farther away.
    confirmed: where the depth of each working picture agrees with another view. These maps may be smaller than the
        pictures here, and have no padding. Elsewhere gradients keep the depth of the scene smooth
        (`tto/smooth_depth.py`; None: nothing does).
    ssim_weight: of D-SSIM, 0.2 by default.
    cut_out: the masks leave out what is around the things in the photos. Gradients keep the scene transparent there.
    """

    views: Views
    cameras: Cameras
    background: Tensor | None = None
    settings: RenderSettings = field(default_factory=RenderSettings)
    backgrounds: torch.Generator | None = None
    exposures: RefittedExposures | None = None
    finest: Cameras | None = None
    perceptual: Perceptual | None = None
    halved: float = 0.0
    confirmed: tuple[Bool[Tensor, "_ _"], ...] | None = None
    ssim_weight: float = SSIM_WEIGHT
    cut_out: bool = False

    @classmethod
    def for_solid_scenes(
        cls, views: Views, cameras: Cameras, generator: torch.Generator, exposures: RefittedExposures | None = None
    ) -> "RenderingLoss":
        """Values over grey, and gradients over random backgrounds; Gaussians no thinner than pixels.

        Over a fixed background, dark or bright places of the photos would become transparent instead of opaque.
        """
        grey, alone = torch.full((3,), MID_GREY, device=cameras.w2c.device), not shows_background(views)
        return cls(views, cameras, grey, backgrounds=generator, exposures=exposures, finest=cameras, cut_out=alone)

    def render(self, gaussians: Gaussians, view: int) -> Rendering:
        """One view over black, in the colours of its photo."""
        return self._exposed(self._render(gaussians, self.cameras, view), view)

    def values(self, gaussians: Gaussians, chosen: list[int]) -> list[float]:
        """The loss of each of the views `chosen`."""
        with torch.no_grad():
            return [self._scores(gaussians, view)[0] for view in chosen]

    def value(self, gaussians: Gaussians, chosen: list[int]) -> float:
        """The loss over the views `chosen`."""
        return sum(self.values(gaussians, chosen)) / len(chosen)

    def psnr(self, gaussians: Gaussians, chosen: list[int]) -> float:
        """The mean over the views `chosen`, in dB."""
        with torch.no_grad():
            return _decibels([self._scores(gaussians, view)[1] for view in chosen])

    def value_and_gradient(self, gaussians: Gaussians, chosen: list[int]) -> LossAndGradient:
        """The loss over the views `chosen`, and its gradient with respect to every Gaussian parameter."""
        behind = _black_or_a_colour(self.backgrounds) if self.backgrounds else self.background
        leaves = gaussians.map(lambda field: field.detach().requires_grad_())
        asked = self.cameras.w2c.requires_grad
        w2c, K = (field.detach().requires_grad_(asked) for field in (self.cameras.w2c, self.cameras.K))
        cameras = replace(self.cameras, w2c=w2c, K=K)
        halve = self.halved > 0 and bool(torch.rand((), generator=self.backgrounds) < self.halved)
        losses, errors = [], []
        for view in chosen:
            rendering = self._render(leaves, cameras, view)
            photo = self._photo(view)
            beside = self._roughness(rendering, photo, view) + self._spilt(rendering, view)
            if self.exposures:
                self.exposures.refit(view, rendering, photo[0][0], photo[1][0])
                rendering = self._exposed(rendering, view)
            picture = self.recorded(rendering.over(behind), photo[0])
            distance = self._distance(picture, photo)
            smaller = TTO_POLICY.half * self._half_loss(leaves, cameras, behind, view, photo) if halve else 0.0
            loss = photometric_loss(picture, *photo, self.ssim_weight) + distance + smaller + beside
            (loss / len(chosen)).backward()
            # Over changing backgrounds the distance is another one than that of the value.
            value, error = self._compared(rendering, photo, view, None if self.backgrounds else distance.detach())
            losses.append(value)
            errors.append(error)
        camera_gradient = (gradient_of(w2c), gradient_of(K)) if asked else None
        return LossAndGradient(losses, _decibels(errors), leaves.map(gradient_of), camera_gradient)

    def _render(self, gaussians: Gaussians, cameras: Cameras, view: int) -> Rendering:
        return render(gaussians, cameras[[view]], settings=self.settings)

    def _half_loss(
        self, gaussians: Gaussians, cameras: Cameras, behind: Tensor | None, view: int, photo: tuple[Tensor, Tensor]
    ) -> Tensor:
        """L1 and D-SSIM of a view at half of the size; pixels count where none of theirs is masked."""
        size = cameras.height // 2, cameras.width // 2
        smaller = F.interpolate(photo[0], size, mode="area")
        mask = F.interpolate(photo[1][:, None].float(), size, mode="area")[:, 0] == 1
        picture = self._exposed(self._render(gaussians, cameras.resized(*size), view), view).over(behind)
        return photometric_loss(self.recorded(picture, smaller), smaller, mask, self.ssim_weight)

    def _roughness(self, rendering: Rendering, photo: tuple[Tensor, Tensor], view: int) -> Tensor | float:
        """How rough the depth is that no other view confirms, by its weight; 0 where this takes no part."""
        if self.confirmed is None:
            return 0.0
        height, width = self.views.sizes[view]
        place = ..., slice(height), slice(width)  # the canvas beside a smaller photo makes it no smoother
        drawn = Rendering(rendering.colour[place], rendering.alpha[place], rendering.depth[place])
        return TTO_POLICY.smoothness * depth_roughness(
            drawn, photo[0][place], photo[1][place], self.guessed(view)[place]
        )

    def _spilt(self, rendering: Rendering, view: int) -> Tensor | float:
        """The alpha beside what a cut-out photo shows, in units of the pixels that it shows, by its weight."""
        if not self.cut_out:
            return 0.0
        (height, width), shown = self.views.sizes[view], self.views.masks[[view]]
        # At the edge of the thing, pixels are partly covered.
        empty = F.max_pool2d(shown[:, None, :height, :width].float(), 3, 1, 1)[:, 0] == 0
        return TTO_POLICY.spilt * rendering.alpha[:, :height, :width][empty].sum() / shown.sum().clamp(min=1)

    def guessed(self, view: int) -> Bool[Tensor, "1 height width"]:
        """The pixels of a view whose depth no other view confirms; none where that is not known."""
        canvas = self.cameras.height, self.cameras.width
        found = torch.zeros((1, *canvas), dtype=torch.bool, device=self.cameras.w2c.device)
        if self.confirmed is not None:
            height, width = self.views.sizes[view]
            guesses = (~self.confirmed[view])[None, None].float()
            found[:, :height, :width] = F.interpolate(guesses, (height, width))[:, 0] == 1
        return found

    def _exposed(self, rendering: Rendering, view: int) -> Rendering:
        return self.exposures.exposed(rendering, view) if self.exposures else rendering

    def recorded(self, picture: Tensor, photo: Tensor) -> Tensor:
        """The render in the colours of its photo, which takes the photo's where that is clipped and the render is not.

        A long exposure is white where others show a colour, whose transform is brighter than white. Without exposures,
        photos agree on what is white.
        """
        if not self.exposures:
            return picture
        blown = (photo >= EXPOSURE_POLICY.white) & (picture > photo)
        return torch.where(blown | ((photo <= 1 - EXPOSURE_POLICY.white) & (picture < photo)), photo, picture)

    def _photo(self, view: int) -> tuple[Tensor, Tensor]:
        """The photo of a view and its mask, as a batch of one."""
        return self.views.picture(view)[None], self.views.masks[[view]]

    def _scores(self, gaussians: Gaussians, view: int) -> tuple[float, float]:
        """The loss of a view and the mean squared error, over `background`."""
        rendering, photo = self.render(gaussians, view), self._photo(view)
        return self._compared(rendering, photo, view)

    def _distance(self, picture: Tensor, photo: tuple[Tensor, Tensor]) -> Tensor:
        """LPIPS by its weight; 0 where it is left out."""
        if self.perceptual is None:
            return picture.new_zeros(())
        return TTO_POLICY.lpips * perceptual_loss(self.perceptual, picture, *photo)

    @torch.no_grad()
    def _compared(
        self, rendering: Rendering, photo: tuple[Tensor, Tensor], view: int, distance: Tensor | None = None
    ) -> tuple[float, float]:
        """The loss and the mean squared error, over `background`; `distance` is that of LPIPS there, if it is known."""
        picture = self.recorded(rendering.over(self.background), photo[0])
        value, error = photometric_value(picture, *photo, self.ssim_weight)
        return value + float(self._distance(picture, photo) if distance is None else distance), error


def _black_or_a_colour(generator: torch.Generator) -> Tensor | None:
    """Black every other time (None), else any colour. Training's "random" is a colour every time.

    Held out on kermit, black and grey, dB: black alone 22.23 and 21.15, colours alone 21.82 and 21.78, both 22.10 and
    21.98.
    """
    colour, draw = torch.rand(3, generator=generator), torch.rand((), generator=generator)
    return colour if draw < 0.5 else None


def gradient_of(leaf: Tensor) -> Tensor:
    """Zeros where nothing reached the leaf."""
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


def _decibels(errors: list[float]) -> float:
    """The mean PSNR of mean squared errors."""
    return sum(-10 * math.log10(max(error, 1e-10)) for error in errors) / len(errors)
