"""The vision geometric model (VGM): photos in; cameras, depth and features out. Always frozen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from querysplat_cli.progress import Progress
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.views import LeftOut, Photo, Views


@dataclass(frozen=True)
class Located:
    """Photos with cameras.

    The first camera is the origin. `points` are sparse scene points [n, 3] (may be empty), `visibility`
    is for each view the row numbers of the points that it saw. `doubts` are sentences that say why the
    cameras may be wrong; empty when nothing speaks against them. `lenses` are the photos' own cameras, as
    they were taken, in the same frame; None where the views are the photos as they are.
    """

    views: Views
    cameras: Cameras
    points: Float[Tensor, "n 3"]
    visibility: tuple[Tensor, ...]
    left_out: tuple[LeftOut, ...] = ()
    doubts: tuple[str, ...] = ()
    lenses: tuple[PhotoCamera, ...] | None = None


@dataclass(frozen=True)
class Geometry:
    """What the VGM knows of each view.

    `depth` is camera z in scene units, positive everywhere inside the view's mask; `confidence` in [0, 1]
    (0: filled in, a guess). `features` holds one tensor for each cached layer, a row for each token of each
    view; for patch-only encoders the tokens are the patches, row by row, `patch` pixels square.
    """

    depth: Float[Tensor, "views height width"]
    confidence: Float[Tensor, "views height width"]
    features: tuple[Float[Tensor, "views tokens channels"], ...]
    patch: int
    doubts: tuple[str, ...] = ()


@runtime_checkable
class Encoder(Protocol):
    """A frozen VGM. `locate` finds cameras, `perceive` finds depth and features for known cameras."""

    name: str

    def locate(
        self,
        photos: Sequence[Photo],
        *,
        max_size: int,
        seed: int,
        progress: Progress,
        known: Mapping[str, PhotoCamera] | None = None,
    ) -> Located:
        """Cameras of the photos, and the photos undistorted at a longer side of at most `max_size` pixels.

        `known` gives cameras by photo name: then none is estimated, and photos without one are left out.
        Raises ImpossibleScene when no two photos can be related.
        """
        ...

    def perceive(self, located: Located, *, seed: int, progress: Progress) -> Geometry:
        """Depth, confidence and features of every view."""
        ...
