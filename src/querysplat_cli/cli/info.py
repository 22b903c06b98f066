"""`querysplat info`: a scene in numbers."""

from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import InfoRequest

BARS = " ▁▂▃▄▅▆▇█"


def info(request: InfoRequest, printing: Printing) -> None:
    """Say what a scene consists of: its size, opacities, orientation, and what is odd about it."""
    from querysplat_cli.cli.terminal import print_json, rows_table, say
    from querysplat_cli.commands.info import scene_info

    found = scene_info(request)
    print_json(found, printing)
    say(rows_table(found["file"], _rows(found)), printing)
    if request.plot:
        say(str(request.plot), printing)


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    extent, odd = found["extent"], found["odd"]
    sides = " × ".join(f"{high - low:.3g}" for low, high in zip(extent["low"], extent["high"], strict=True))
    cameras = "none beside it" if found["cameras"] is None else str(found["cameras"])
    return [
        ("Gaussians", f"{found['gaussians']:,}, SH degree {found['sh_degree']}, {found['bytes'] / 2**20:.2f} MiB"),
        ("backdrop", _backdrop(found["backdrop"], found["gaussians"])),
        ("extent", f"{sides} units (x, y, z), without the outer 5 % at either end"),
        ("opacity", f"{_bars(found['opacity'])} 0 to 1, median {found['opacity']['quantiles']['0.5']:.2f}"),
        ("size", f"{_bars(found['size'])} {_range(found['size'])}"),
        ("orientation", _orientation(found["orientation"])),
        ("input cameras", cameras),
        ("needles", _share(odd["needles"], "over 10 times as long as wide")),
        ("giants", _share(odd["giants"], "longer than a tenth of the extent")),
        ("see-through", _share(odd["see_through"], "of opacity below 0.05")),
        ("floaters", _share(odd["floaters"], "far from all others")),
    ]


def _backdrop(behind: int, whole: int) -> str:
    if not behind:
        return "none"
    return f"{behind:,} behind everything, {'left out below' if behind < whole else 'and nothing else'}"


def _bars(histogram: dict[str, Any]) -> str:
    """The counts as a row of bars; a bin with few Gaussians still shows."""
    most = max(histogram["counts"])
    return "".join(BARS[-(-count * (len(BARS) - 1) // most)] for count in histogram["counts"])


def _range(size: dict[str, Any]) -> str:
    least, median, largest = (size["quantiles"][level] for level in ("0", "0.5", "1"))
    return f"{least:.2g} to {largest:.2g} units (longest axis, logarithmic), median {median:.2g}"


def _orientation(found: dict[str, Any]) -> str:
    if found["tilt"] is None:
        return "no cameras beside it say where up is"
    return f"by the photos, up is {found['tilt']:.1f}° from -y, which viewers take for up"


def _share(odd: dict[str, Any], meaning: str) -> str:
    return f"{odd['count']:,} ({100 * odd['share']:.1f} %) {meaning}"
