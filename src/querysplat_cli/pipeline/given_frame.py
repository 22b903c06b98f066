"""The frame of the cameras that the user gave, and the way back to it."""

from collections.abc import Mapping

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.match_cameras import rigid
from querysplat_cli.scene.sim3 import DegenerateAlignment, Sim3, align_cameras


def given_frame(posed: PosedViews, known: Mapping[str, PhotoCamera] | None) -> Sim3 | None:
    """The similarity from the frame of `posed` to that of the `known` cameras; None where none are known.

    An encoder keeps the given poses up to a similarity. Where all cameras stand at one place, lengths keep the unit of
    `posed`.
    """
    rows = [row for row, name in enumerate(posed.views.names) if known and name in known]
    if not known or not rows:
        return None
    given = torch.stack([torch.from_numpy(rigid(known[posed.views.names[row]].w2c)) for row in rows])
    ours = posed.cameras.w2c[rows].double()
    if posed.photo_cameras is not None:
        ours = torch.stack([torch.from_numpy(posed.photo_cameras[row].w2c).double() for row in rows])
    try:
        return align_cameras(ours, given)
    except DegenerateAlignment:
        rotation = given[0, :3, :3].T @ ours[0, :3, :3]
        return Sim3(1.0, rotation, given[0, :3, :3].T @ (ours[0, :3, 3] - given[0, :3, 3]))


def rounding_warnings(
    posed: PosedViews, known: Mapping[str, PhotoCamera] | None, gaussians: Gaussians
) -> tuple[str, ...]:
    """A sentence where the `known` cameras are so far from their origin that files blur the scene; nothing otherwise.

    `gaussians` are in the frame of `posed`. Files hold float32, whose steps grow with the distance from the origin.
    """
    frame = given_frame(posed, known)
    if frame is None:
        return ()
    places = gaussians.means.double()
    moved = frame.apply(places)
    lost = (moved.float().double() - moved).norm(dim=1).median()
    depth = frame.scale * (places - posed.cameras.centres.double().mean(0)).norm(dim=1).median()
    pixels = float(lost / depth * posed.cameras.K[:, 0, 0].median())
    if not pixels >= PIPELINE_POLICY.rounded_pixels:  # not a number where there are no Gaussians
        return ()
    far = f"{float(moved.norm(dim=1).median()):,.0f} units from their origin"
    return (
        f"the given cameras are {far}, where numbers in files of Gaussians are rounded by {float(lost):.2g}, which "
        f"blurs the scene by {pixels:.2g} pixels: subtract the mean place of the cameras from all of them",
    )
