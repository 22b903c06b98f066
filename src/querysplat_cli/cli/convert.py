"""`querysplat convert`: Gaussians and cameras from one kind of file to another."""

from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import Conversion


def convert(request: Conversion, printing: Printing) -> None:
    """Convert Gaussians, or cameras, from one kind of file to another.

    Gaussians can be turned, scaled and cropped on the way.
    """
    from querysplat_cli.cli.terminal import print_json, say
    from querysplat_cli.commands.convert import convert as run

    result = run(request)
    print_json(result, printing)
    for line in _lines(result):
        say(line, printing)


def _lines(result: dict[str, Any]) -> list[str]:
    if "cameras" in result:
        left_out = [f"left out: {each['name']}, {each['why']}" for each in result.get("left_out", ())]
        return [f"{result['cameras']} cameras: {result['target']}", *left_out]
    sizes = result["bytes"]
    left = f", {result['left_out']:,} left out" if result["left_out"] else ""
    written, read = (sizes[part] / 2**20 for part in ("target", "source"))
    return [f"{result['gaussians']:,} Gaussians{left}, {written:.2f} MiB (source {read:.2f} MiB): {result['target']}"]
