"""`querysplat reconstruct`: photos in, scene out."""

from enum import StrEnum
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from querysplat_cli.cli.options import (
    Device,
    Encoder,
    Force,
    Json,
    NetworkPrecision,
    Precision,
    Preset,
    Prune,
    Queries,
    Quiet,
    RefineCameras,
    Seed,
    TtoSpace,
    Weights,
    amount,
    number_or_auto,
)


class TtoTarget(StrEnum):
    kv = "kv"
    features = "features"


class PhotoFit(StrEnum):
    crop = "crop"
    pad = "pad"


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
    budget: Annotated[
        float | None,
        typer.Option(min=1.0, metavar="SECONDS", help="Time for everything: sets picture size and optimisation."),
    ] = None,
    tto_target: Annotated[
        TtoTarget, typer.Option(help="What it optimises: keys and values, or the features that they are made of.")
    ] = TtoTarget.kv,
    tto_space: Annotated[
        TtoSpace, typer.Option(help="Optimise the memories, the Gaussians themselves, or both in turn.")
    ] = TtoSpace.features,
    queries: Queries = "auto",
    prune: Prune = "auto",
    keep_everything: Annotated[
        bool, typer.Option("--keep-everything", help="Leave nothing out that could be, for comparison.")
    ] = False,
    max_size: Annotated[
        str, typer.Option(metavar="PX|auto", help="Longer side of the working pictures; auto: the encoder's own.")
    ] = "auto",
    max_views: Annotated[
        str, typer.Option(metavar="N|auto", help="Use N photos, evenly spaced; auto: as many as fit into memory.")
    ] = "auto",
    fit: Annotated[PhotoFit, typer.Option(help="Photos for a network: a centred square, or whole.")] = PhotoFit.crop,
    preset: Preset = "compact",
    encoder: Encoder = None,
    weights: Weights = None,
    precision: Precision = NetworkPrecision.fp32,
    refine_cameras: RefineCameras = None,
    depth: Annotated[bool, typer.Option(help="Find depth as well, where the model does not need it.")] = False,
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
    started = perf_counter()
    steps, limit = number_or_auto(0)(tto), number_or_auto(1)(queries)
    size, most = number_or_auto(96)(max_size), number_or_auto(1)(max_views)
    from querysplat_cli.cli.console import exit_if_interrupted, print_report, showing_stages
    from querysplat_cli.pipeline.reconstruct import reconstruct as run
    from querysplat_cli.pipeline.settings import ReconstructSettings

    settings = ReconstructSettings(
        inputs=tuple(inputs),
        ply=output,
        holdout_every=holdout_every,
        holdout_cameras=holdout_cameras.value,
        tto=steps,
        tto_target=tto_target.value,
        tto_space=tto_space.value,
        queries=limit,
        max_size=size,
        max_views=most,
        fit=fit.value,
        preset=preset,
        encoder=encoder,
        weights=weights,
        precision=precision.value,
        depth=depth,
        poses=poses,
        device=device,
        seed=seed,
        force=force,
        prune=amount(prune),
        keep_everything=keep_everything,
        budget=budget,
        refine_cameras=refine_cameras,
    )
    with showing_stages(quiet=quiet, started=started) as stages:
        report = run(settings, stages)
    print_report(report, quiet=quiet, as_json=json)
    exit_if_interrupted(report)
