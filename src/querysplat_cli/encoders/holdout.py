"""Photos left out of the scene, and where they were taken from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.runtime.choices import HoldoutProtocol
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, project
from querysplat_cli.scene.sim3 import DegenerateAlignment, align_cameras, rotation_angles
from querysplat_cli.scene.views import LeftOut, Photo, Views


@dataclass(frozen=True)
class CameraPass:
    """The inputs of a scene, and the held-out views in the same frame (None when there are none)."""

    source: HoldoutProtocol
    inputs: PosedViews
    heldout: tuple[Views, Cameras] | None


@dataclass(frozen=True)
class PoseDifference:
    """How far the input cameras of the two passes lie apart after alignment.

    Mean rotation in degrees, and mean displacement in pixels of the scene points that each camera sees (None
    where there are no points).
    """

    degrees: float
    pixels: float | None


@dataclass(frozen=True)
class Passes:
    """`chosen` makes the scene that is kept; `other` a second one, only to be scored."""

    chosen: CameraPass
    other: CameraPass | None
    difference: PoseDifference | None
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]


def split_photos(photos: Sequence[Photo], every: int | None) -> tuple[list[Photo], list[Photo]]:
    """Inputs and held-out photos: photos 0, N, 2N, … are held out (the LLFF convention)."""
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


def camera_passes(
    photos: Sequence[Photo],
    every: int | None,
    source: HoldoutProtocol,
    estimate_cameras: Callable[[Sequence[Photo]], PosedViews],
    *,
    poses_known: bool,
    own_frame: bool = False,
) -> Passes:
    """Cameras for the inputs and the held-out photos, in the one or two passes that the protocol asks for.

    `estimate_cameras(photos)` is one pass. The *isolated* protocol (paper, Comparisons) locates the inputs by
    themselves, locates everything a second time, and joins the two by the similarity of the shared input
    cameras; the *joint* one takes all cameras from the pass over everything. Known poses need one pass. With
    `own_frame`, a scene fits the cameras of its own pass alone: there is no joint protocol then, and
    QuerySplatError is raised where it is asked for.
    """
    if own_frame and source == "joint" and every is not None:
        raise QuerySplatError(
            "--holdout-cameras joint: this encoder's features belong to the cameras of their own pass",
            "Use --holdout-cameras isolated.",
        )
    inputs, heldout = split_photos(photos, every)
    names = [photo.name for photo in inputs]
    if not heldout:
        posed = estimate_cameras(inputs)
        return Passes(CameraPass("isolated", posed, None), None, None, posed.left_out, posed.warnings)
    everything = estimate_cameras(photos)
    joint = _joint_pass(everything, names)
    if poses_known:
        return Passes(joint, None, None, everything.left_out, everything.warnings)
    own = estimate_cameras(inputs)
    isolated, difference, warnings = isolated_pass(own, everything, names)
    chosen, other = (isolated, joint) if source == "isolated" else (joint, isolated)
    second = None if own_frame else other
    left_out = tuple(dict.fromkeys((*own.left_out, *everything.left_out)))
    return Passes(
        chosen, second, difference, left_out, tuple(dict.fromkeys((*own.warnings, *everything.warnings, *warnings)))
    )


def take(posed: PosedViews, rows: Sequence[int]) -> PosedViews:
    """The same cameras and points, with only some of the views."""
    return replace(
        posed,
        views=posed.views[rows],
        cameras=posed.cameras[rows],
        visibility=tuple(posed.visibility[row] for row in rows),
        photo_cameras=posed.photo_cameras and tuple(posed.photo_cameras[row] for row in rows),
    )


def _rows(posed: PosedViews, names: Sequence[str], *, inside: bool) -> list[int]:
    wanted = set(names)
    return [row for row, name in enumerate(posed.views.names) if (name in wanted) == inside]


def _heldout(everything: PosedViews, cameras: Cameras, names: Sequence[str]) -> tuple[Views, Cameras] | None:
    rows = _rows(everything, names, inside=False)
    return (everything.views[rows], cameras[rows]) if rows else None


def _joint_pass(everything: PosedViews, names: Sequence[str]) -> CameraPass:
    rows = _rows(everything, names, inside=True)
    return CameraPass("joint", take(everything, rows), _heldout(everything, everything.cameras, names))


def isolated_pass(
    own: PosedViews, everything: PosedViews, names: Sequence[str]
) -> tuple[CameraPass, PoseDifference | None, tuple[str, ...]]:
    """The scene of the pass `own` over the photos `names` alone, with the other views of `everything` brought to it.

    Where no similarity joins the two there are no held-out views, and a sentence says why.
    """
    shared = [name for name in own.views.names if name in everything.views.names]
    mine = [own.views.names.index(name) for name in shared]
    theirs = [everything.views.names.index(name) for name in shared]
    try:
        similarity = align_cameras(everything.cameras.w2c[theirs], own.cameras.w2c[mine])
    except DegenerateAlignment as error:
        return CameraPass("isolated", own, None), None, (f"held-out photos cannot be scored in isolation: {error}",)
    cameras = everything.cameras.transformed(similarity)
    difference = _pose_difference(own, mine, cameras[theirs])
    return CameraPass("isolated", own, _heldout(everything, cameras, names)), difference, ()


def _pose_difference(own: PosedViews, rows: Sequence[int], others: Cameras) -> PoseDifference:
    degrees, pixels = [], []
    for row, w2c, K in zip(rows, others.w2c.double(), others.K.double(), strict=True):
        mine, lens = own.cameras.w2c[row].double(), own.cameras.K[row].double()
        degrees.append(rotation_angles(w2c[:3, :3] @ mine[:3, :3].T))
        points = own.points[own.visibility[row]].double()
        if len(points):
            pixels.append((project(points, mine, lens) - project(points, w2c, K)).norm(dim=1).median())
    return PoseDifference(float(torch.stack(degrees).mean()), float(torch.stack(pixels).mean()) if pixels else None)
