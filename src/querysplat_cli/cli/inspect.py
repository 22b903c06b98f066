"""`querysplat inspect`: pictures of what a scene consists of."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import InspectRequest


def inspect(request: InspectRequest, printing: Printing) -> None:
    """Draw what a stored scene consists of.

    The pictures are a query's attention on the photos and its Gaussians, histograms of opacity and scale, and the
    Gaussians' centres beside the points of the depth.
    """
    from querysplat_cli.cli.terminal import print_json, say, showing_stages
    from querysplat_cli.commands.inspect import inspect_scene

    with showing_stages(printing) as stages:
        found = inspect_scene(request, stages)
    print_json(vars(found), printing)
    for warning in found.warnings:
        say(f"warning: {warning}", printing)
    say(f"query {found.query}: attention, histograms and points are in {found.output}", printing)
