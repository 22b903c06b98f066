"""`querysplat demo`: photos of a procedural scene, and the scene reconstructed from the photos."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import DemoRequest
from querysplat_cli.runtime.colmap import load_pycolmap


def demo(request: DemoRequest, printing: Printing) -> None:
    """Photograph a procedural 3D scene, and reconstruct it like any other photos. Needs no network."""
    load_pycolmap()
    from querysplat_cli.cli.print_report import exit_if_interrupted, print_report
    from querysplat_cli.cli.terminal import showing_stages
    from querysplat_cli.commands.demo import run_demo

    with showing_stages(printing) as stages:
        report = run_demo(request, stages)
    print_report(report, printing)
    exit_if_interrupted(report)
