"""What every encoder offers: photos in; cameras, depth and features out.

An encoder is a vision geometric model (VGM). Its weights, where it has any, are never trained here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.choices import Fit, Frame, Matcher, Precision
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.views import LeftOut, Photo, Views


@dataclass(frozen=True)
class EncoderOptions:
    """How an encoder works. The classical encoder reads `weights` and `matcher`, learned encoders all but `matcher`.

    `weights` is the folder of the checkpoints (None: the Hugging Face cache). `mixture` holds a weight for each
    cached layer: the features are then the weighted sum of the layers alone. With `depth` False, no depth map is
    computed. `matcher` matches the photos. `frame` is that of the cameras (`PosedViews`).
    """

    weights: Path | None = None
    device: torch.device = torch.device("cpu")  # noqa: RUF009 - immutable
    precision: Precision = "fp32"
    fit: Fit = "crop"
    mixture: tuple[float, ...] | None = None
    depth: bool = True
    matcher: Matcher = "auto"
    frame: Frame = "predicted"


@dataclass(frozen=True)
class CameraRequest:
    """How cameras are estimated.

    `max_size` is the largest longer side of the undistorted photos, in pixels. `seed` makes the result
    repeatable. `known` gives cameras by photo name: then none is estimated, and photos without one are left out.
    """

    max_size: int
    seed: int
    known: Mapping[str, PhotoCamera] | None = None


@dataclass(frozen=True)
class Matching:
    """What was done for photos that SIFT matches badly.

    The network `matcher` searched `pairs` of them again, in `seconds`. `matches` are those of these pairs that agree,
    before and after. With `kept` False, the cameras from before were better. `missing` says what a network lacks that
    would have been used; `matcher` is empty then.
    """

    matcher: str
    pairs: int
    matches: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    kept: bool = True
    missing: str = ""


@dataclass(frozen=True)
class PosedViews:
    """Undistorted photos with cameras, all in one frame.

    The encoder chooses the frame and its unit:

    - `classical`: the camera of the first photo is the origin, exactly. The median depth of the points, over all
      views that observe them, is 1. Without points the unit means nothing.
    - `vggt`, `vggt_omega`: the frame and unit of the network's pass, unchanged. The network predicts the first
      camera like every other one, so it is the origin only approximately. With the frame "first_view", cameras and
      points are moved rigidly, and it is the origin exactly.

    A selection of the views (`holdout.select_views`) keeps the frame of the whole: its first camera may stand
    anywhere.

    `points` are sparse scene points [n, 3], and n may be 0. `visibility` holds, for each view, the row numbers of
    the points that the view observes, and `keypoints` the pixels [k, 2] of the photo where it does, in pixels of
    `photo_cameras` (None: not known). Each of `warnings` is a sentence that says why the cameras may be wrong.
    `photo_cameras` are the cameras of the photos before undistortion, in the same frame; None where the views show
    the photos without resampling. `epipolar_error_px` is the median distance of the matches from their epipolar
    lines, in pixels of the views; None where it was not measured. `matching` says how photos were matched again, if any
    was. `chance_pairs` of photos matched by chance and were left out. `depth_maps` are those that came with the
    photos, as the views see them: camera z in any unit, 0 where there is none.
    """

    views: Views
    cameras: Cameras
    points: Float[Tensor, "n 3"]
    visibility: tuple[Tensor, ...]
    left_out: tuple[LeftOut, ...] = ()
    warnings: tuple[str, ...] = ()
    photo_cameras: tuple[PhotoCamera, ...] | None = None
    epipolar_error_px: float | None = None
    matching: Matching | None = None
    keypoints: tuple[Tensor, ...] | None = None
    chance_pairs: int = 0
    depth_maps: Float[Tensor, "views height width"] | None = None


@dataclass(frozen=True)
class UsedDepthMaps:
    """Which views (row numbers) came with a depth map, which of these maps are used, and how far those are off.

    `difference` is the median relative difference to depth that the photos confirm; None where they confirm none.
    `per_unit` is the length of a scene unit in that of the maps; None where they have no common one.
    """

    given: tuple[int, ...]
    used: tuple[int, ...]
    difference: float | None
    per_unit: float | None

    def entry(self) -> dict[str, Any]:
        """What the report says of them, which counts the maps."""
        return {**vars(self), "given": len(self.given), "used": len(self.used)}


@dataclass(frozen=True)
class Geometry:
    """Depth and features of the views, in the frame of their `PosedViews`.

    `depth` is camera z in scene units, positive everywhere inside the view's mask. `confidence` is in [0, 1]; 0
    marks a depth that was filled in. Both are None where no depth was asked for. `features` holds one tensor for
    each cached layer, with a row for each token of each view. In a patch-only encoder the tokens are the patches,
    row by row. A patch is `patch` pixels square. `depth_maps` says what became of `PosedViews.depth_maps`.
    """

    depth: Float[Tensor, "views height width"] | None
    confidence: Float[Tensor, "views height width"] | None
    features: tuple[Float[Tensor, "views tokens channels"], ...]
    patch: int
    warnings: tuple[str, ...] = ()
    depth_maps: UsedDepthMaps | None = None


@runtime_checkable
class Encoder(Protocol):
    """A frozen VGM.

    `size` is the longer side, in pixels, at which the encoder works best. With `own_frame`, the features belong to
    the frame of their own pass: cameras of another pass fit them only after a similarity.
    """

    name: str
    size: int
    own_frame: bool

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        """Cameras of the photos, and the photos undistorted. `PosedViews` says in which frame.

        Raises ImpossibleScene when no two photos can be related, and QuerySplatError when the encoder cannot take
        known cameras.
        """
        ...

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """Depth, confidence and features of every view.

        An encoder with `own_frame` returns those of the pass that found the cameras. It recognises that pass by the
        object `posed.views`; other views, even equal ones, cost another pass.
        """
        ...

    def free(self) -> None:
        """Release what memory can be released. The encoder is not used afterwards."""
        ...

    def bytes_needed(self, views: int, size: int) -> int | None:
        """About the most memory that so many views of `size` × `size` pixels take, weights included.

        None where it is unknown, and too little to matter.
        """
        ...
