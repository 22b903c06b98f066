"""Held-out photos, and their cameras in the frame of the inputs.

Held-out photos are scored but make no part of the scene. There are two protocols:

- *isolated* (the paper's comparisons): the cameras of the inputs come from a pass over the inputs alone. A second pass
  over all photos finds the held-out cameras. The similarity between the two passes' input cameras joins them.
- *joint*: all cameras come from one pass over all photos. The score is that of the scene alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.runtime.choices import HoldoutProtocol
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, project_points
from querysplat_cli.scene.rotations import rotation_angles
from querysplat_cli.scene.sim3 import DegenerateAlignment, align_cameras
from querysplat_cli.scene.views import LeftOut, Photo, Views

LOOSE_PX = 0.5
"""Passes whose points lie further apart, in pixels, are warned of. Riverview, with 0.6, lost 1.8 dB by it."""


@dataclass(frozen=True)
class PosedSplit:
    """The inputs of a scene, and the held-out views in the same frame (None when there are none).

    `heldout_photo_cameras` are the lenses of the held-out photos, in no frame: only their intrinsics mean something.
    None as in `PosedViews`.
    """

    protocol: HoldoutProtocol
    inputs: PosedViews
    heldout: tuple[Views, Cameras] | None
    heldout_photo_cameras: tuple[PhotoCamera, ...] | None = None


@dataclass(frozen=True)
class PoseDifference:
    """How far the input cameras of two passes lie apart after alignment.

    `degrees` is the mean rotation. `pixels` is the mean over the views of the median displacement of the scene points
    that each view observes; None where there are no points.
    """

    degrees: float
    pixels: float | None


@dataclass(frozen=True)
class HoldoutCameras:
    """Inputs and held-out views, and what the pass or the passes said.

    `difference` compares the input cameras of the two passes; None where there was one pass, or where they cannot be
    aligned.
    """

    split: PosedSplit
    difference: PoseDifference | None
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]


def split_photos(photos: Sequence[Photo], every: int | None) -> tuple[list[Photo], list[Photo]]:
    """Inputs and held-out photos. Photos 0, N, 2N, … are held out for `every` = N (the LLFF convention).

    Raises QuerySplatError when fewer than two inputs are left.
    """
    if every is None:
        return list(photos), []
    inputs = [photo for i, photo in enumerate(photos) if i % every]
    heldout = [photo for i, photo in enumerate(photos) if i % every == 0]
    if len(inputs) < 2:
        raise QuerySplatError(
            f"holding out every {every}th of {len(photos)} photos leaves {len(inputs)} to make a scene from",
            "Use a larger --holdout-every, or more photos.",
        )
    return inputs, heldout


def estimate_holdout_cameras(
    photos: Sequence[Photo],
    every: int | None,
    protocol: HoldoutProtocol,
    estimate_cameras: Callable[[Sequence[Photo]], PosedViews],
    *,
    poses_known: bool,
    own_frame: bool = False,
) -> HoldoutCameras:
    """Cameras of the inputs and of the held-out photos, in the one or two passes that the protocol needs.

    `estimate_cameras(photos)` is one pass. Known poses need one pass, since both protocols are then the same. With
    `own_frame` (see `Encoder`) a scene fits the cameras of its own pass only, so there is no joint protocol: raises
    QuerySplatError when it is chosen. Raises ImpossibleScene when a joint pass places held-out photos only.
    """
    if own_frame and protocol == "joint" and every is not None:
        raise QuerySplatError(
            "--holdout-cameras joint: the features of this encoder fit only the cameras of their own pass",
            "Use --holdout-cameras isolated.",
        )
    inputs, heldout = split_photos(photos, every)
    names = [photo.name for photo in inputs]
    if not heldout:
        posed = estimate_cameras(inputs)
        return HoldoutCameras(PosedSplit("isolated", posed, None), None, posed.left_out, posed.warnings)
    everything = estimate_cameras(photos)
    if poses_known or protocol == "joint":
        return HoldoutCameras(_joint_split(everything, names), None, everything.left_out, everything.warnings)
    # The inputs come last: a learned encoder keeps its last pass for depth and features.
    own = estimate_cameras(inputs)
    split, difference, warnings = isolated_split(own, everything, names)
    if difference and difference.pixels is not None and difference.pixels > LOOSE_PX and not own_frame:
        warnings += (
            f"the passes with and without the held-out photos put points {difference.pixels:.1f} pixels apart, so the "
            "held-out score is lower than the scene deserves: --holdout-cameras joint scores the scene alone",
        )
    return HoldoutCameras(
        split,
        difference,
        left_out=tuple(dict.fromkeys((*own.left_out, *everything.left_out))),
        warnings=tuple(dict.fromkeys((*own.warnings, *everything.warnings, *warnings))),
    )


def select_views(posed: PosedViews, rows: Sequence[int]) -> PosedViews:
    """The views of these row numbers, in the same frame and with the same points."""
    return replace(
        posed,
        views=posed.views[rows],
        cameras=posed.cameras[rows],
        visibility=tuple(posed.visibility[row] for row in rows),
        photo_cameras=posed.photo_cameras and tuple(posed.photo_cameras[row] for row in rows),
        keypoints=posed.keypoints and tuple(posed.keypoints[row] for row in rows),
    )


def isolated_split(
    own: PosedViews, everything: PosedViews, names: Sequence[str]
) -> tuple[PosedSplit, PoseDifference | None, tuple[str, ...]]:
    """The inputs by the pass `own`, and the other views of the pass `everything` moved to its frame.

    `names` are the inputs. Where no similarity joins the two passes there are no held-out views, and a warning says
    why.
    """
    shared = [name for name in own.views.names if name in everything.views.names]
    mine = [own.views.names.index(name) for name in shared]
    theirs = [everything.views.names.index(name) for name in shared]
    try:
        similarity = align_cameras(everything.cameras.w2c[theirs], own.cameras.w2c[mine])
    except DegenerateAlignment as error:
        warning = f"held-out photos cannot be scored in isolation: {error}"
        return PosedSplit("isolated", own, None), None, (warning,)
    cameras = everything.cameras.transformed(similarity)
    difference = _pose_difference(own, mine, cameras[theirs])
    return _split("isolated", own, everything, cameras, names), difference, ()


def _joint_split(everything: PosedViews, names: Sequence[str]) -> PosedSplit:
    inputs = set(names)
    rows = [row for row, name in enumerate(everything.views.names) if name in inputs]
    if not rows:
        raise ImpossibleScene(
            "only held-out photos have a camera, so nothing is left to make a scene of",
            "Leave out --holdout-every, or choose another number.",
        )
    return _split("joint", select_views(everything, rows), everything, everything.cameras, names)


def _split(
    protocol: HoldoutProtocol, inputs: PosedViews, everything: PosedViews, cameras: Cameras, names: Sequence[str]
) -> PosedSplit:
    """`inputs`, and those views of `everything` whose names are not among `names`, with these `cameras`."""
    others = set(everything.views.names) - set(names)
    rows = [row for row, name in enumerate(everything.views.names) if name in others]
    lenses = everything.photo_cameras and tuple(everything.photo_cameras[row] for row in rows)
    return PosedSplit(protocol, inputs, (everything.views[rows], cameras[rows]) if rows else None, lenses)


def _pose_difference(own: PosedViews, rows: Sequence[int], others: Cameras) -> PoseDifference:
    """Between the cameras of `own` in these rows and `others`, which are in the same frame."""
    degrees, pixels = [], []
    for row, other_w2c, other_K in zip(rows, others.w2c.double(), others.K.double(), strict=True):
        own_w2c, own_K = own.cameras.w2c[row].double(), own.cameras.K[row].double()
        degrees.append(rotation_angles(other_w2c[:3, :3] @ own_w2c[:3, :3].T))
        points = own.points[own.visibility[row]].double()
        if len(points):
            shift = project_points(points, own_w2c, own_K) - project_points(points, other_w2c, other_K)
            pixels.append(shift.norm(dim=1).median())
    return PoseDifference(float(torch.stack(degrees).mean()), float(torch.stack(pixels).mean()) if pixels else None)
