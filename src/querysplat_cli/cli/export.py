"""`querysplat export`: a scene as one file for browsers."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import ExportRequest


def export(request: ExportRequest, printing: Printing) -> None:
    """Write a scene, its photos and the viewer to one HTML file, which opens from disk without a network."""
    from querysplat_cli.cli.terminal import print_json, say
    from querysplat_cli.commands.export import export_scene

    done = export_scene(request)
    print_json(vars(done), printing)
    photos = f", with {done.photos} photos" if done.photos else ""
    say(f"{done.output}: {done.bytes / 2**20:.1f} MiB{photos}; a browser with WebGL 2 opens it", printing)
