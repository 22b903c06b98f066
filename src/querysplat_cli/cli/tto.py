"""`querysplat tto`: take a scene up again and optimise it further."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Device, Json, Prune, Quiet, RefineCameras, Seed, TtoSpace, amount, number_or_auto


def tto(
    scene: Annotated[Path, typer.Argument(help="The folder that `reconstruct` wrote, or the .ply beside it.")],
    steps: Annotated[str, typer.Option(metavar="STEPS|auto", help="Optimisation steps.")] = "auto",
    lr: Annotated[
        float | None,
        typer.Option(min=1e-8, help="Learning rate; 0.02, or 0.005 for a scene that was optimised before."),
    ] = None,
    space: Annotated[
        TtoSpace | None,
        typer.Option(help="Optimise the memories, the Gaussians themselves, or both in turn; as last time by default."),
    ] = None,
    prune: Prune = "off",
    densify: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="In Gaussian space: split Gaussians where photos and renders differ, up to N."
        ),
    ] = None,
    refine_cameras: RefineCameras = False,
    weights: Annotated[Path | None, typer.Option(help="The folder of downloaded weights, if not where it was.")] = None,
    device: Device = "auto",
    seed: Seed = 42,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Optimise a scene further on its photos, and update the .ply, the folder and the report.

    Ctrl-C ends the optimisation and keeps what it reached.
    """
    count = number_or_auto(0)(steps)
    from querysplat_cli.cli.console import exit_if_interrupted, print_report, showing_stages
    from querysplat_cli.pipeline.resume import optimise_scene
    from querysplat_cli.tto.options import OptimiseOptions

    with showing_stages(quiet=quiet) as stages:
        report = optimise_scene(
            scene,
            OptimiseOptions(
                steps=count,
                lr=lr,
                space=None if space is None else space.value,
                prune=amount(prune),
                densify_to=densify,
                refine_cameras=bool(refine_cameras),
                seed=seed,
            ),
            stages,
            device=device,
            weights=weights,
        )
    print_report(report, quiet=quiet, as_json=json)
    exit_if_interrupted(report)
