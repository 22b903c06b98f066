"""`querysplat convert`: Gaussians and cameras from one kind of file to another."""

from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.cli.words import decibels, left_out
from querysplat_cli.commands.convert_request import Conversion

REASONS = {"unsupported": "that no photo supports", "giants": "giant", "islands": "in islands"}


def convert(request: Conversion, printing: Printing) -> None:
    """Convert Gaussians, or cameras, from one kind of file to another.

    Gaussians can be turned, scaled, cleaned and cut on the way. What that costs in PSNR is printed.
    """
    from querysplat_cli.cli.terminal import print_json, say, showing_stages
    from querysplat_cli.commands.convert import convert as run

    with showing_stages(printing) as stages:
        result = run(request, stages)
    print_json(result, printing)
    for line in lines(result):
        say(line, printing)


def lines(result: dict[str, Any]) -> list[str]:
    if "cameras" in result:
        return [f"{result['cameras']} cameras{_points(result)}: {result['target']}", *left_out(result["left_out"])]
    written, read = (result["bytes"][part] / 2**20 for part in ("target", "source"))
    return [
        f"{_content(result)}, {written:.2f} MiB (source {read:.2f} MiB): {result['target']}",
        *([f"with its folder: {result['scene']}"] if result["scene"] else []),
        *(f"warning: {each}" for each in result.get("warnings", ())),
        *map(_step, result["steps"]),
        *[_level(number, level) for number, level in enumerate(result.get("levels", ()))],
        *([_cost(result["psnr"])] if result["psnr"] else []),
    ]


def _points(result: dict[str, Any]) -> str:
    if not result.get("points"):
        return ""
    if not result["observations"]:
        return f", and {result['points']:,} centres of Gaussians as points, which no photo observes"
    return f", and {result['points']:,} triangulated points with {result['observations']:,} observations"


def _content(result: dict[str, Any]) -> str:
    if "points" in result:
        return f"{result['points']:,} points, the centres of the most opaque Gaussians"
    if "triangles" in result:
        return f"{result['triangles']:,} triangles with {result['corners']:,} corners"
    return f"{result['gaussians']:,} Gaussians"


def _level(number: int, level: dict[str, Any]) -> str:
    return f"level {number}: {level['gaussians']:,} Gaussians, {level['psnr']:.2f} dB"


def _step(step: dict[str, Any]) -> str:
    counts = ", ".join(f"{step[name]:,} {word}" for name, word in REASONS.items() if step.get(name))
    reasons = f" ({counts})" if counts else ""
    # Pictures of the source agree with themselves by 100 dB, so that the least change would seem to lose half of that.
    cost = decibels(step["lost"]) if step["against"] == "photos" else f"pictures agree to {step['psnr']:.2f} dB"
    return f"{step['what']}: {step['gaussians']:,} left out{reasons}, {cost}"


def _cost(psnr: dict[str, Any]) -> str:
    if psnr["against"] == "photos":
        change = f"{psnr['before']:.2f} → {psnr['after']:.2f} dB, {decibels(psnr['lost'])}"
        return f"on {psnr['views']} of the photos: {change}"
    where = "from the input cameras" if psnr["against"] == "inputs" else "from all around"
    return f"against pictures of the source {where}: {psnr['after']:.2f} dB (100: no difference)"
