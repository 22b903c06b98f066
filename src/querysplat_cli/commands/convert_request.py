"""What `querysplat convert` can be asked for. Every option is declared here, and only here; nothing needs torch."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le

from querysplat_cli.runtime.choices import SpzVersion
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.options import Force, Option

BOX = "X0,Y0,Z0,X1,Y1,Z1"
AXES = {
    f"{sign}{name}": tuple(float(f"{sign}1") if name == other else 0.0 for other in "xyz")
    for sign in ("", "-")
    for name in "xyz"
}
SHORTEST_DIRECTION = 1e-12
"""Of a direction for --up."""


def read_box(option: str, text: str) -> tuple[float, ...]:
    """The corners x0, y0, z0, x1, y1, z1; raises QuerySplatError unless the first lies below the second."""
    box = _numbers(text)
    if len(box) != 6 or not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise QuerySplatError(f"{option} {shown(text)}: not a box", "Write x0,y0,z0,x1,y1,z1 with x0 < x1 and so on.")
    return box


def read_sphere(text: str) -> tuple[float, ...]:
    """Centre and radius; raises QuerySplatError unless the radius is positive."""
    sphere = _numbers(text)
    if len(sphere) != 4 or not sphere[3] > 0:
        raise QuerySplatError(f"--keep-sphere {shown(text)}: not a sphere", "Write x,y,z,r with r above 0.")
    return sphere


def read_up(text: str) -> tuple[float, ...] | Literal["auto"]:
    """A direction; raises QuerySplatError unless it is one."""
    if text == "auto":
        return "auto"
    direction = AXES.get(text) or _numbers(text)
    if len(direction) != 3 or not SHORTEST_DIRECTION < math.hypot(*direction) < math.inf:
        raise QuerySplatError(f"--up {shown(text)}: not a direction", "Write auto, an axis such as z, or x,y,z.")
    return direction


def _numbers(text: str) -> tuple[float, ...]:
    """Finite numbers between commas; none where something else is there."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return numbers if all(math.isfinite(number) for number in numbers) else ()


@dataclass(frozen=True)
class Conversion:
    """A file of Gaussians or of cameras, and what it becomes."""

    source: Annotated[
        Path,
        Option(
            "Gaussians: a .ply, .spz, .sog or .glb, a scene folder, or the lod-meta.json of a streamed SOG. Cameras: a "
            "transforms.json, a COLMAP model, LLFF's poses_bounds.npy or a scene folder.",
            argument=True,
        ),
    ]
    target: Annotated[
        Path,
        Option(
            "Gaussians: a .ply, .spz, .sog or .glb, or a folder with the suffix .lod for levels of detail. Cameras: a "
            ".json, or a folder for COLMAP.",
            argument=True,
        ),
    ]
    spz_version: Annotated[
        SpzVersion, Option("Of an .spz: 3, which most viewers read, or 4, whose compression is newer.")
    ] = "3"
    levels: Annotated[
        int | None,
        Ge(1),
        Le(16),
        Option("Of a .lod: the number of coarser levels. By default the coarsest has at most a million.", metavar="N"),
    ] = None
    text: Annotated[bool, Option("Write the COLMAP model as text.")] = False
    photos: Annotated[
        Path | None,
        Option("The folder of the cameras' photos. TARGET becomes a scene folder of both.", metavar="DIR"),
    ] = None
    up: Annotated[
        tuple[float, ...] | Literal["auto"] | None,
        Option(
            "The direction that points up in the source, as an axis or as X,Y,Z. It becomes -y. auto turns the scene "
            "as `reconstruct` does, by the cameras beside it.",
            metavar="auto|x|y|z|-x|-y|-z|X,Y,Z",
            parse=read_up,
        ),
    ] = None
    scale: Annotated[float, Ge(1e-9), Le(1e9), Option("Multiply all lengths by this number.", metavar="FACTOR")] = 1.0
    clean: Annotated[bool, Option("Leave out small islands, and giants and others that no photo needs.")] = False
    no_backdrop: Annotated[bool, Option("Leave out the backdrop, which makes the box large that viewers frame.")] = (
        False
    )
    crop: Annotated[
        tuple[float, ...] | None,
        Option(
            "Keep only Gaussians whose centres lie in this box, in the axes and units of the result.",
            metavar=BOX,
            parse=partial(read_box, "--crop"),
        ),
    ] = None
    remove: Annotated[
        tuple[float, ...] | None,
        Option("Leave out Gaussians whose centres lie in this box.", metavar=BOX, parse=partial(read_box, "--remove")),
    ] = None
    keep_sphere: Annotated[
        tuple[float, ...] | None,
        Option(
            "Keep only Gaussians whose centres lie within R of X,Y,Z, in the axes and units of the result.",
            metavar="X,Y,Z,R",
            parse=read_sphere,
        ),
    ] = None
    prune_to: Annotated[
        int | None,
        Ge(1),
        Option("Keep the N Gaussians whose absence would change the views most.", ("--prune",), metavar="N"),
    ] = None
    points: Annotated[bool, Option("Write a point cloud: centres and colours of the opaque Gaussians.")] = False
    mesh: Annotated[
        bool,
        Option("Write a coloured triangle mesh of the surface that the input cameras see: a .ply, .glb or .obj."),
    ] = False
    force: Force = False

    @property
    def geometry(self) -> bool:
        """Whether points or a mesh are written in place of Gaussians."""
        return self.points or self.mesh

    @property
    def changes(self) -> bool:
        """Whether Gaussians are turned, scaled or cut."""
        cuts = self.clean, self.no_backdrop, self.crop, self.remove, self.keep_sphere, self.prune_to
        return bool(self.up) or self.scale != 1.0 or any(cuts)
