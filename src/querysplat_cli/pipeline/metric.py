"""The size of a scene in metres, where the user asks for it."""

from collections.abc import Sequence

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.metres import Metres, metres_by_distances, metres_by_gps
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo

BY_GPS = "gps"
LONGEST_METRES = 1e7


def read_scale(text: str) -> str:
    """The value of --scale as it was given; raises QuerySplatError when it is neither gps nor distances."""
    if text != BY_GPS:
        _lengths(text)
    return text


def metres_of(scale: str, names: Sequence[str], cameras: Cameras, photos: Sequence[Photo]) -> Metres:
    """The length of the unit of `cameras`, whose photos have these names. Raises as `scene/metres.py` does."""
    centres = dict(zip(names, cameras.centres.double().numpy(), strict=True))
    if scale == BY_GPS:
        return metres_by_gps(centres, {photo.name: photo.gps for photo in photos if photo.gps})
    return metres_by_distances(centres, _lengths(scale))


def in_metres(frame: Sim3 | None, metres: Metres) -> Sim3:
    """The frame of the files with the same axes and origin, and with metres for units."""
    before = frame or Sim3.identity()
    return Sim3(metres.per_unit, before.rotation, before.translation * (metres.per_unit / before.scale))


def _lengths(text: str) -> list[tuple[str, str, float]]:
    """From a.jpg,b.jpg=1.5;c.jpg,d.jpg=2."""
    found = []
    for part in text.split(";"):
        names, _, length = part.rpartition("=")
        one, _, other = names.partition(",")
        try:
            metres = float(length)
        except ValueError:
            metres = 0.0
        if not (one and other and 0 < metres <= LONGEST_METRES):
            raise QuerySplatError(
                f"--scale {shown(text)}: neither gps nor a distance between two photos",
                "Write gps, or a.jpg,b.jpg=1.5 for 1.5 m between them; separate several by a semicolon.",
            )
        found.append((one.strip(), other.strip(), metres))
    return found
