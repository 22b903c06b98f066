"""`querysplat inspect`: pictures of what a scene is made of."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Force, Json, Quiet


def inspect(
    scene: Annotated[Path, typer.Argument(help="The folder that `reconstruct` wrote, or the .ply beside it.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="A folder for the pictures.")] = None,
    query: Annotated[int | None, typer.Option(min=0, help="Whose attention to draw; the most opaque one's.")] = None,
    weights: Annotated[Path | None, typer.Option(help="The folder of downloaded weights, if not where it was.")] = None,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Draw a query's attention on the photos, histograms of opacity and scale, and points beside the depth."""
    from querysplat_cli.cli.console import console, showing_stages
    from querysplat_cli.commands.inspect import inspect_scene

    folder = output or scene.with_name(f"{scene.stem}-inspected")
    with showing_stages(quiet=quiet) as stages:
        found = inspect_scene(scene, folder, query=query, weights=weights, force=force, stages=stages)
    if json:
        print(found.json())
    if not quiet:
        console.print(f"query {found.query}: attention, histograms and points are in {found.output}")
