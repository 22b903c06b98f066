"""What the small verbs can be asked for. Every option is declared here, and only here; nothing needs torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.options import Force, MovedWeights, Option, Seed, StoredScenePath
from querysplat_cli.scene.files import with_name

ScenePath = Annotated[
    Path, Option("A scene folder, or a .ply, .spz, .sog or .glb of SH degree 0 to 3.", metavar="SCENE", argument=True)
]

LARGEST_SIZE = 65535
"""Pixels of the longest side of a picture that common formats can hold."""


def read_size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"; raises QuerySplatError for anything else."""
    width, _, height = text.lower().partition("x")
    digits = width.isdecimal() and height.isdecimal() and max(len(width), len(height)) <= len(str(LARGEST_SIZE))
    if not (digits and min(int(width), int(height)) > 0 and max(int(width), int(height)) <= LARGEST_SIZE):
        raise QuerySplatError(
            f"--size {shown(text)}: not a size",
            f"Write it as WIDTHxHEIGHT with sides up to {LARGEST_SIZE}, for instance 1280x720.",
        )
    return int(height), int(width)


def read_colour(text: str) -> tuple[float, float, float]:
    """Red, green and blue of "R,G,B"; raises QuerySplatError unless they are three numbers from 0 to 1."""
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if not all(0 <= part <= 1 for part in (red, green, blue)):
            raise ValueError
    except ValueError:
        raise QuerySplatError(
            f"--background {shown(text)}: not a colour", "Write three numbers from 0 to 1: 1,1,1."
        ) from None
    return red, green, blue


def beside(scene: Path, what: str) -> Path:
    """The folder SCENE-what for results, beside a scene's folder or file."""
    place = with_name(scene)
    return place.with_name(f"{place.name if place.is_dir() else place.stem}-{what}")


@dataclass(frozen=True)
class RenderRequest:
    """Pictures or a film of a .ply."""

    scene: ScenePath
    output: Annotated[
        Path | None,
        Option(
            "A folder for PNG frames, or a film that ends in .mp4.",
            ("--output", "-o"),
            metavar="DIR|FILE.mp4",
            default="SCENE-renders, beside the .ply",
        ),
    ] = None
    cameras: Annotated[
        str,
        Option(
            "The input cameras (inputs; in a film, a smooth path through them), a path around the scene (orbit), or a "
            "transforms.json, a COLMAP model's folder or LLFF's poses_bounds.npy. auto is inputs where they are known, "
            "and orbit elsewhere.",
            metavar="auto|inputs|orbit|FILE",
        ),
    ] = "auto"
    frames: Annotated[
        int | None, Ge(1), Le(1_000_000), Option("The number of frames of an orbit.", metavar="N", default="90")
    ] = None
    seconds: Annotated[
        float | None,
        Ge(0.1),
        Le(600.0),
        Option(
            "The length of a film.",
            metavar="S",
            default="1.5 for each step between input cameras, 3 to 12; an orbit's --frames",
        ),
    ] = None
    fps: Annotated[int, Ge(1), Le(1000), Option("The frames per second of a film.", metavar="N")] = 30
    size: Annotated[
        tuple[int, int] | None,
        Option("The size of the frames, in pixels.", metavar="WxH", default="the cameras' own", parse=read_size),
    ] = None
    background: Annotated[
        tuple[float, float, float],
        Option("The colour behind the scene: red, green and blue from 0 to 1.", metavar="R,G,B", parse=read_colour),
    ] = (0.0, 0.0, 0.0)
    depth: Annotated[bool, Option("Write depth, too: 16-bit PNG, in thousandths of a scene unit.")] = False
    float_depth: Annotated[
        bool, Option("Write depth, too, and its confidence: .npy of 32-bit floats, depth in scene units.")
    ] = False
    alpha: Annotated[bool, Option("Write opacity, too: 8-bit PNG.")] = False
    force: Force = False

    @property
    def target(self) -> Path:
        """The folder or the film to write."""
        return self.output or beside(self.scene, "renders")

    @property
    def is_film(self) -> bool:
        return self.target.suffix.lower() == ".mp4"


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


@dataclass(frozen=True)
class InspectRequest:
    """Pictures of what a stored scene consists of."""

    scene: StoredScenePath
    output: Annotated[
        Path | None,
        Option(
            "A folder for the pictures.",
            ("--output", "-o"),
            metavar="DIR",
            default="SCENE-inspected, beside the scene",
        ),
    ] = None
    query: Annotated[
        int | None,
        Ge(0),
        Option("The number of the query whose attention is drawn.", metavar="N", default="the most opaque one"),
    ] = None
    weights: MovedWeights = None
    force: Force = False

    @property
    def target(self) -> Path:
        """The folder to write."""
        return self.output or beside(self.scene, "inspected")


@dataclass(frozen=True)
class DemoRequest:
    """Photos of a procedural scene, and the scene that is reconstructed from them."""

    output: Annotated[Path, Option("A folder for the photos and the scene.", ("--output", "-o"), metavar="DIR")] = Path(
        "querysplat-demo"
    )
    photos: Annotated[int, Ge(3), Le(10_000), Option("How many photos to take.", metavar="N")] = 12
    seed: Seed = 42
    force: Force = False


@dataclass(frozen=True)
class PosesRequest:
    """Two sets of cameras of the same photos."""

    first: Annotated[
        Path,
        Option(
            "A scene folder, transforms.json, COLMAP model or LLFF's poses_bounds.npy. For --colmap, its photos must "
            "lie beside it.",
            metavar="A",
            argument=True,
        ),
    ]
    second: Annotated[Path | None, Option("The cameras that A is measured against.", metavar="[B]", argument=True)] = (
        None
    )
    colmap: Annotated[bool, Option("In place of B, run COLMAP on A's photos.")] = False
    plot: Annotated[
        Path | None, Option("Draw both trajectories to a .png, .svg or .pdf.", metavar="FILE", default="no drawing")
    ] = None
    seed: Seed = 42
    force: Force = False


@dataclass(frozen=True)
class WeightsRequest:
    """The weight files to look for."""

    folder: Annotated[
        Path | None,
        Option("The folder of the files.", ("--weights",), metavar="DIR", default="the Hugging Face cache"),
    ] = None
    verify: Annotated[bool, Option("Read the files that are here: sha256, and names and shapes of tensors.")] = False
