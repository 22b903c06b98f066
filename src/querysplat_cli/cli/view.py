"""`querysplat view`: a scene in the browser."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import ViewRequest


def view(request: ViewRequest, printing: Printing) -> None:
    """Show a scene in the browser, with its cameras and photos, without any network. Ctrl-C ends it."""
    from querysplat_cli.cli.terminal import print_json, say
    from querysplat_cli.commands.view import view_scene

    def announce(address: str) -> None:
        print_json({"address": address}, printing)
        say(f"{address} shows {request.scene}; Ctrl-C ends it", printing)

    view_scene(request, announce)
