"""`querysplat demo`: photos of a made-up scene, and the scene made of the photos."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Force, Json, Quiet, Seed


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder for the photos and the scene.")] = Path(
        "querysplat-demo"
    ),
    photos: Annotated[int, typer.Option(min=3, help="How many photos to take.")] = 12,
    seed: Seed = 42,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Photograph a procedural 3D scene, offline, and reconstruct it like any other photos."""
    from querysplat_cli.cli.console import console, print_report, showing_stages
    from querysplat_cli.commands.demo import run_demo

    with showing_stages(quiet=quiet) as stages:
        report = run_demo(output, photos=photos, seed=seed, force=force, stages=stages)
    print_report(report, quiet=quiet, as_json=json)
    if not quiet:
        console.print(f"The scene:   {report.ply}   (open it in any 3D Gaussian splatting viewer)")
        console.print(f"The preview: {Path(report.scene) / 'preview.png'}   (photos beside renders)")
