"""The size of a scene in metres, where the user asks for it."""

from collections.abc import Sequence
from dataclasses import replace

from querysplat_cli.encoders.base import PosedViews, UsedDepthMaps
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.lengths import BY_DEPTH, BY_GPS, lengths
from querysplat_cli.scene.metres import Metres, check_gps, check_names, metres_by_distances, metres_by_gps
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo


def check_scale(scale: str | None, photos: Sequence[Photo], *, poses_known: bool) -> None:
    """Raise QuerySplatError where a value of --scale cannot hold, whichever of the photos get a camera.

    Known cameras have a unit.
    """
    if scale is None:
        return
    if poses_known:
        raise QuerySplatError("--scale: the cameras of --poses have a unit already", "Leave one of the two out.")
    if scale == BY_DEPTH:
        if all(photo.depth_map is None for photo in photos):
            raise QuerySplatError("--scale depth: there are no depth maps", "Give them with --depth-maps.")
    elif scale == BY_GPS:
        check_gps(sum(photo.gps is not None for photo in photos), len(photos))
    else:
        check_names(lengths(scale), {photo.name for photo in photos})


def metres_of(scale: str | None, posed: PosedViews, photos: Sequence[Photo]) -> Metres | None:
    """The length of the unit of `posed`, by the value of --scale; None without one, and where depth maps will tell.

    Raises as `scene/metres.py` does.
    """
    if scale in (None, BY_DEPTH):
        return None
    centres = dict(zip(posed.views.names, posed.cameras.centres.double().numpy(), strict=True))
    if scale == BY_GPS:
        return metres_by_gps(centres, {photo.name: photo.gps for photo in photos if photo.gps})
    return metres_by_distances(centres, lengths(scale))


def in_metres(scene: StoredScene, report: Report, metres: Metres) -> tuple[StoredScene, Report]:
    """The scene whose files have metres for units, and the report that says so."""
    return replace(scene, frame=rescaled_frame(scene.frame, metres)), replace(report, scale=metres.entry())


def in_metres_of_depth(scene: StoredScene, report: Report, maps: UsedDepthMaps | None) -> tuple[StoredScene, Report]:
    """`in_metres` by the unit of depth maps; a warning instead where they have no common one."""
    if maps is None or maps.per_unit is None:
        warning = "the depth maps have no common unit, so lengths are not in metres"
        return scene, replace(report, warnings=[*report.warnings, warning])
    return in_metres(scene, report, Metres(maps.per_unit, BY_DEPTH, len(maps.used), None))


def rescaled_frame(frame: Sim3 | None, metres: Metres) -> Sim3:
    """The frame of the files with the same axes and origin, and with metres for units."""
    before = frame or Sim3.identity()
    return Sim3(metres.per_unit, before.rotation, before.translation * (metres.per_unit / before.scale))
