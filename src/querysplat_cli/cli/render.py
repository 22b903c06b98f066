"""`querysplat render`: pictures or a film of any 3DGS .ply."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Force, Json, Quiet
from querysplat_cli.runtime.errors import QuerySplatError


def render(
    scene: Annotated[Path, typer.Argument(help="A 3D Gaussian splatting .ply, SH degree 0 to 3.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="A folder for PNG frames, or a film ending in .mp4.")
    ] = None,
    cameras: Annotated[
        str,
        typer.Option(
            metavar="auto|inputs|orbit|FILE",
            help="The input cameras, an orbit, or a cameras.json; auto: the inputs where they are known.",
        ),
    ] = "auto",
    frames: Annotated[int, typer.Option(min=1, help="Frames of an orbit.")] = 90,
    fps: Annotated[int, typer.Option(min=1, help="Frames per second of a film.")] = 30,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size in pixels; the cameras' own by default.")
    ] = None,
    background: Annotated[str, typer.Option(metavar="R,G,B", help="Colour behind the scene, 0 to 1.")] = "0,0,0",
    depth: Annotated[bool, typer.Option(help="Also write depth, 16-bit PNG, thousandths of a scene unit.")] = False,
    alpha: Annotated[bool, typer.Option(help="Also write alpha, 8-bit PNG.")] = False,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Render a scene to PNG frames or to a film."""
    chosen_size, colour = _size(size), _colour(background)
    from querysplat_cli.cli.console import print_rendered, showing_stages
    from querysplat_cli.commands.render import RenderRequest, render_file

    request = RenderRequest(
        scene=scene,
        output=output or scene.with_name(f"{scene.stem}-renders"),
        cameras=cameras,
        frames=frames,
        fps=fps,
        size=chosen_size,
        background=colour,
        depth=depth,
        alpha=alpha,
        force=force,
    )
    with showing_stages(quiet=quiet) as stages:
        rendered = render_file(request, stages)
    print_rendered(rendered, quiet=quiet, as_json=json)


def _size(text: str | None) -> tuple[int, int] | None:
    """(height, width) of WxH."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise QuerySplatError(f"--size {text}: not a size", "Write it as WIDTHxHEIGHT, for instance 1280x720.")
    return int(height), int(width)


def _colour(text: str) -> tuple[float, float, float]:
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if not all(0 <= part <= 1 for part in (red, green, blue)):
            raise ValueError
    except ValueError:
        raise QuerySplatError(f"--background {text}: not a colour", "Write three numbers from 0 to 1: 1,1,1.") from None
    return red, green, blue
