"""`querysplat reconstruct`: photos in, scene out."""

from time import perf_counter

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import Watching
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.colmap import load_pycolmap


def reconstruct(settings: ReconstructSettings, printing: Printing, watching: Watching) -> None:
    """Turn photos without camera poses into a 3D Gaussian splatting scene."""
    started = perf_counter()
    load_pycolmap()
    from querysplat_cli.cli.print_report import exit_if_interrupted, print_report
    from querysplat_cli.cli.watching import watching_stages
    from querysplat_cli.pipeline.reconstruct import reconstruct as run

    with watching_stages(watching, printing, settings.ply.stem, started=started) as stages:
        report = run(settings, stages)
    print_report(report, printing)
    exit_if_interrupted(report)
