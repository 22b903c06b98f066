"""What the verbs that show a scene can be asked for. Nothing here needs torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from querysplat_cli.runtime.options import Force, Option

ScenePath = Annotated[
    Path, Option("A scene folder, or a .ply, .spz, .sog or .glb of SH degree 0 to 3.", metavar="SCENE", argument=True)
]


@dataclass(frozen=True)
class ViewRequest:
    """A scene in the browser."""

    scene: ScenePath
    browser: Annotated[bool, Option("Open the browser.", ("--browser/--no-browser",))] = True
    port: Annotated[
        int, Ge(0), Le(65535), Option("The port on 127.0.0.1.", metavar="N", default="0: any free port")
    ] = 0


@dataclass(frozen=True)
class ExportRequest:
    """A scene in one file for browsers."""

    scene: ScenePath
    output: Annotated[
        Path | None, Option("The file to write.", ("--output", "-o"), metavar="FILE.html", default="SCENE.html")
    ] = None
    with_photos: Annotated[
        bool, Option("Put small copies of the photos into the file, beside their cameras.", ("--photos/--no-photos",))
    ] = True
    force: Force = False


@dataclass(frozen=True)
class InfoRequest:
    """What a scene consists of, in numbers."""

    scene: ScenePath
    plot: Annotated[
        Path | None, Option("Draw the histograms to a .png, .svg or .pdf.", metavar="FILE", default="no drawing")
    ] = None
    force: Force = False


@dataclass(frozen=True)
class Watching:
    """Whether a run is watched."""

    view: Annotated[bool, Option("Show the scene in the browser while it is made.")] = False
