"""`querysplat render`: pictures or a film of any 3DGS .ply."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import RenderRequest


def render(request: RenderRequest, printing: Printing) -> None:
    """Render a scene to PNG frames or to a film."""
    from querysplat_cli.cli.terminal import print_json, say, showing_stages
    from querysplat_cli.commands.render import render_file

    with showing_stages(printing) as stages:
        done = render_file(request, stages)
    print_json(vars(done), printing)
    seconds = sum(done.seconds.values())
    say(f"{done.frames} frames of {done.gaussians:,} Gaussians in {seconds:.1f} s: {done.output}", printing)
