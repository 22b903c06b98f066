"""`querysplat reconstruct`: photos in, scene out."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Device, Force, Json, Quiet, Seed, number_or_auto


class HeldOutCameras(StrEnum):
    isolated = "isolated"
    joint = "joint"


def reconstruct(
    inputs: Annotated[list[Path], typer.Argument(metavar="IMAGES...", help="A folder of photos, or photo files.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The scene to write; its folder, of the same name, goes beside it.")
    ] = Path("scene.ply"),
    holdout_every: Annotated[
        int | None, typer.Option(min=2, help="Leave photos 0, N, 2N, … out of everything but the final score.")
    ] = None,
    holdout_cameras: Annotated[
        HeldOutCameras,
        typer.Option(help="Cameras of the scene: from the inputs alone, or from one pass over all photos."),
    ] = HeldOutCameras.isolated,
    tto: Annotated[
        str, typer.Option(metavar="STEPS|auto", help="Steps of test-time optimisation; 0 for none.")
    ] = "auto",
    queries: Annotated[
        str, typer.Option(metavar="N|auto", help="At most this many queries, nine Gaussians each.")
    ] = "auto",
    max_size: Annotated[int, typer.Option(min=96, help="Longer side of the working pictures, in pixels.")] = 448,
    preset: Annotated[str, typer.Option(help="The model: a preset, or a checkpoint file.")] = "compact",
    encoder: Annotated[str, typer.Option(help="The vision geometric model.")] = "classical",
    poses: Annotated[
        Path | None, typer.Option(help="Known cameras, instead of SfM: transforms.json or a COLMAP model folder.")
    ] = None,
    device: Device = "auto",
    seed: Seed = 42,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Turn photos, with no camera poses, into a 3D Gaussian splatting scene."""
    steps, limit = number_or_auto(0)(tto), number_or_auto(1)(queries)
    from querysplat_cli.cli.console import print_report, showing_stages
    from querysplat_cli.pipeline import ReconstructSettings
    from querysplat_cli.pipeline import reconstruct as run

    settings = ReconstructSettings(
        inputs=tuple(inputs),
        ply=output,
        holdout_every=holdout_every,
        holdout_cameras=holdout_cameras.value,
        tto=steps,
        queries=limit,
        max_size=max_size,
        preset=preset,
        encoder=encoder,
        poses=poses,
        device=device,
        seed=seed,
        force=force,
    )
    with showing_stages(quiet=quiet) as stages:
        report = run(settings, stages)
    print_report(report, quiet=quiet, as_json=json)
