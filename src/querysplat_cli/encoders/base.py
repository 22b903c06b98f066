"""The vision geometric model (VGM): photos in; cameras, depth and features out. Always frozen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.choices import Fit, Precision
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.views import LeftOut, Photo, Views


@dataclass(frozen=True)
class EncoderOptions:
    """How an encoder is to work; those without weights need none of it.

    `weights` is the folder of their files (None: the Hugging Face cache). With a `mixture`, a weight for each
    layer, features are the layers' sum alone. `depth` False leaves the depth out where that saves work.
    """

    weights: Path | None = None
    device: torch.device = torch.device("cpu")  # noqa: RUF009 - immutable
    precision: Precision = "fp32"
    fit: Fit = "crop"
    mixture: tuple[float, ...] | None = None
    depth: bool = True


@dataclass(frozen=True)
class PosedViews:
    """Photos with cameras.

    The first camera is the origin. `points` are sparse scene points [n, 3] (may be empty), `visibility`
    is for each view the row numbers of the points that it saw. `warnings` are sentences that say why the
    cameras may be wrong; empty when nothing speaks against them. `photo_cameras` are the photos' own cameras, as
    they were taken, in the same frame; None where the views' masks hold the photos as they are. `epipolar_error_px` is
    the median distance in pixels of matches from their epipolar lines, None where it was not measured.
    """

    views: Views
    cameras: Cameras
    points: Float[Tensor, "n 3"]
    visibility: tuple[Tensor, ...]
    left_out: tuple[LeftOut, ...] = ()
    warnings: tuple[str, ...] = ()
    photo_cameras: tuple[PhotoCamera, ...] | None = None
    epipolar_error_px: float | None = None


@dataclass(frozen=True)
class Geometry:
    """What the VGM knows of each view.

    `depth` is camera z in scene units, positive everywhere inside the view's mask; `confidence` in [0, 1]
    (0: filled in, a guess); both None where they were not asked for. `features` holds one tensor for each
    cached layer, a row for each token of each view; for patch-only encoders the tokens are the patches, row
    by row, `patch` pixels square.
    """

    depth: Float[Tensor, "views height width"] | None
    confidence: Float[Tensor, "views height width"] | None
    features: tuple[Float[Tensor, "views tokens channels"], ...]
    patch: int
    warnings: tuple[str, ...] = ()


@runtime_checkable
class Encoder(Protocol):
    """A frozen VGM. `estimate_cameras` finds cameras, `estimate_geometry` finds depth and features for known cameras.

    `size` is the longer side, in pixels, that it works best at. With `own_frame`, features are tied to the
    frame of their own pass, and cameras of another pass fit them only after a similarity.
    """

    name: str
    size: int
    own_frame: bool

    def estimate_cameras(
        self,
        photos: Sequence[Photo],
        *,
        max_size: int,
        seed: int,
        progress: Progress,
        known: Mapping[str, PhotoCamera] | None = None,
    ) -> PosedViews:
        """Cameras of the photos, and the photos undistorted at a longer side of at most `max_size` pixels.

        `known` gives cameras by photo name: then none is estimated, and photos without one are left out.
        Raises ImpossibleScene when no two photos can be related.
        """
        ...

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """Depth, confidence and features of every view."""
        ...

    def free(self) -> None:
        """Give back what memory can be: it will not be asked again."""
        ...

    def bytes_needed(self, views: int, size: int) -> int | None:
        """About the most memory that so many views of `size` × `size` pixels take, weights included.

        None where it is not known, and too little to matter.
        """
        ...
