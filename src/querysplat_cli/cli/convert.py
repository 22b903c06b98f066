"""`querysplat convert`: Gaussians and cameras from one kind of file to another."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Force, Json, Quiet
from querysplat_cli.runtime.errors import QuerySplatError


class Axis(StrEnum):
    x = "x"
    y = "y"
    z = "z"
    minus_x = "-x"
    minus_y = "-y"
    minus_z = "-z"


def convert(
    source: Annotated[
        Path, typer.Argument(help="A .ply, .spz or .sog; or cameras: transforms.json, COLMAP model, scene folder.")
    ],
    target: Annotated[Path, typer.Argument(help="A .ply or .spz; or a .json, or a folder for a COLMAP model.")],
    photos: Annotated[
        Path | None, typer.Option(help="The folder of the cameras' photos: TARGET becomes a scene folder of both.")
    ] = None,
    text: Annotated[bool, typer.Option(help="Write the COLMAP model as text.")] = False,
    up: Annotated[Axis | None, typer.Option(help="The axis that points up in the source; becomes -y.")] = None,
    scale: Annotated[float, typer.Option(help="Multiply all lengths.")] = 1.0,
    crop: Annotated[
        str | None, typer.Option(metavar="X0,Y0,Z0,X1,Y1,Z1", help="Keep centres in this box of the result.")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Convert Gaussians (.ply, .spz, from .sog; turned, scaled, cropped), or cameras between all that hold them."""
    box = _box(crop)
    if not scale > 0:
        raise QuerySplatError(f"--scale {scale}: lengths must stay positive", "Give a number above 0.")
    from querysplat_cli.cli.console import print_conversion
    from querysplat_cli.commands.convert import Conversion
    from querysplat_cli.commands.convert import convert as run

    request = Conversion(
        source, target, text=text, photos=photos, up=up and up.value, scale=scale, crop=box, force=force
    )
    print_conversion(run(request), quiet=quiet, as_json=json)


def _box(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        box = tuple(float(part) for part in text.split(","))
    except ValueError:
        box = ()
    if len(box) != 6 or not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise QuerySplatError(f"--crop {text}: not a box", "Write x0,y0,z0,x1,y1,z1 with x0 < x1 and so on.")
    return box
