"""How the CPU splatter scales, and what its knobs buy: error against run time.

    python benchmarks/splat_curves.py [--write docs/splatter.md] [--json results.json] [--against REVISION]

Scaling: the random scenes of `splat.py`, each in a process of its own, so that memory is the scene's own. Knobs:
50,000 Gaussians at 512 × 512 for the time; a piece of the same density for the error, against float64
blending without any cut-off but the cap on α (`alpha_min` 1e-8, `transmittance_min` 0).
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import splat
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.splat.render import RenderSettings, render

EXACT = RenderSettings(alpha_min=1e-8, transmittance_min=0.0)
GAUSSIANS = (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = (64, 128, 256, 512, 1024, 2048)
VIEWS = (1, 2, 4, 8, 16)
TILES = ((8, 8), (8, 16), (8, 32), (16, 8), (16, 16), (16, 32), (16, 64), (32, 16))
PIECE, PIECE_GAUSSIANS = 128, 3125
"""What the error is measured on."""
TILE_LINE = "WIDE, HIGH = 16, 32"
LIMITS = {
    "alpha_min": (1 / 32, 1 / 64, 1 / 128, 1 / 255, 1 / 400),
    "transmittance_min": (0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5),
}
READING = """The two cut-offs are those of 3DGS, so that a scene looks the same in every viewer, and the curves
bear them out. At α = 1/255 the largest error is about one step of 8 bits; a coarser cut-off saves a few hundredths of
the time for each doubling of the error, a finer one costs as little and shows in no picture. Stopping pixels earlier
saves next to nothing until it is visible, stopping them later changes nothing. The tile is the fastest of those tried
and changes no pixel. float32 is not where the error is: against the same cut-offs in float64 it is the "colour error"
of the first table, a ten-thousandth of what the α cut-off costs."""
Row = dict[str, Any]
TEMPLATE = """# The splatter's time, memory and error

Made by

    {command}

on {machine}.

Scenes are random: Gaussians of about 8 px (3 standard deviations) and opacities of 0.05 to 0.95
that fill the picture; everything from centres and spherical harmonics to pixels is included, and back. Milliseconds
are medians, on a virtual machine whose neighbours can be heard: repeated runs differ by a tenth.

## Where it stands

{standing}

## Scaling

{scaling}

The slopes are those of time over the larger half of each range, in log–log scale: 1 is linear. Memory grows by the
rows of the Gaussians (52 bytes, 40 more for each thread backward, and their gradients), 4 bytes for each pair of tile
and Gaussian, and 20 bytes for each pixel of each view.

## Error against time

The error is the largest and the mean difference of colour, on {piece_gaussians:,} Gaussians in {piece} × {piece}
pixels, from blending in float64 without any cut-off; a colour spans 0 to 1. **Bold** is the default.

{knobs}

{reading}

![scaling and knobs]({picture})
"""


def kernel(tree: Path = splat.ROOT, **options: float) -> Row:
    """Milliseconds and megabytes of one scene, in a process of its own."""
    row = splat.in_tree(tree, [f"--{name}={value}" for name, value in options.items()])
    return {"ms": row["kernel_ms"]["both"], "mb": max(row["peak_mb"], 0.1)}


def scaling() -> dict[str, list[Row]]:
    """The three series of scenes."""
    return {
        "Gaussians (512 × 512)": [{"x": n, **kernel(gaussians=n, repeats=3 if n > 200_000 else 9)} for n in GAUSSIANS],
        "pixels a side (50,000 Gaussians)": [{"x": side, **kernel(size=side, repeats=5)} for side in SIZES],
        "views (20,000 Gaussians, 256 × 256)": [
            {"x": views, **kernel(gaussians=20_000, size=256, views=views, repeats=5)} for views in VIEWS
        ],
    }


def slope(rows: list[Row]) -> float:
    """Of log time over log x, in the larger half."""
    half = rows[len(rows) // 2 :]
    return float(np.polyfit(*(np.log([row[key] for row in half]) for key in ("x", "ms")), 1)[0])


@contextmanager
def with_tile(wide: int, high: int) -> Iterator[Path]:
    """A copy of the sources with another tile."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        shutil.copytree(splat.ROOT / "src", tree / "src", ignore=shutil.ignore_patterns("__pycache__"))
        file = tree / "src" / "querysplat_cli" / "splat" / "compiled_tiles.py"
        text = file.read_text()
        assert TILE_LINE in text
        file.write_text(text.replace(TILE_LINE, f"WIDE, HIGH = {wide}, {high}"))
        yield tree


def knobs() -> dict[str, list[Row]]:
    """Error and time for each value of each knob."""
    piece = splat.random_scene(PIECE_GAUSSIANS, PIECE, 8.0, 1, 0)
    whole = splat.random_scene(50_000, 512, 8.0, 1, 0)
    exact_scene = piece[0].to(torch.float64)
    exact = render(exact_scene, piece[1], backend="reference", settings=EXACT).colour

    def row(value: str, default: bool, ms: float, colour: torch.Tensor) -> Row:
        difference = (colour.double() - exact).abs()
        error = {"max": float(difference.max()), "mean": float(difference.mean())}
        return {"value": value, "default": default, "ms": ms, **error}

    default = RenderSettings()
    result: dict[str, list[Row]] = {}
    for name, values in LIMITS.items():
        result[name] = []
        for value in values:
            settings = replace(default, **{name: value})
            ms = splat.timing(*whole, "cpu", 9, settings).both
            colour = render(*piece, settings=settings).colour
            text = f"1/{round(1 / value)}" if name == "alpha_min" else f"{value:g}"
            result[name].append(row(text, value == getattr(default, name), ms, colour))
    colour = render(*piece).colour
    result["tile, pixels"] = []
    for wide, high in TILES:
        with with_tile(wide, high) as tree:
            kernel(tree, repeats=1)  # compiles
            ms = kernel(tree)["ms"]
        chosen = f"WIDE, HIGH = {wide}, {high}" == TILE_LINE
        result["tile, pixels"].append(row(f"{wide} × {high}", chosen, ms, colour))
    result["precision, on the piece"] = [
        row("kernel, float32", True, splat.timing(*piece, "cpu", 9).both, colour),
        *(
            row(f"plain torch, {str(dtype)[6:]}", False,
                splat.timing(piece[0].to(dtype), piece[1], "reference", 1).both,
                render(piece[0].to(dtype), piece[1], backend="reference").colour)
            for dtype in (torch.float32, torch.float64)
        ),
    ]  # fmt: skip
    return result


def plot(scales: dict[str, list[Row]], knob_rows: dict[str, list[Row]], path: Path) -> None:
    figure = new_figure(15, 3.6)
    axes = figure.subplots(1, 4)
    for axis, (name, rows) in zip(axes, scales.items(), strict=False):
        axis.loglog([row["x"] for row in rows], [row["ms"] for row in rows], "C0.-", label="ms, both passes")
        axis.loglog([row["x"] for row in rows], [row["mb"] for row in rows], "C1.--", label="MB beyond the start")
        axis.set_title(name, fontsize=10)
        axis.legend(fontsize=7)
    for (name, rows), colour in zip(list(knob_rows.items())[:2], ("C2", "C3"), strict=True):
        axes[3].semilogy([row["ms"] for row in rows], [row["max"] for row in rows], f"{colour}.-", label=f"{name}, max")
        axes[3].semilogy([row["ms"] for row in rows], [row["mean"] for row in rows], f"{colour}.:", label="mean")
    axes[3].set_title("error against ms", fontsize=10)
    axes[3].legend(fontsize=7)
    save_figure(figure, path)


def markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def standing(rows: list[Row]) -> str:
    """What one run of splat.py says of each of the two sizes that are quoted."""
    head = ("Gaussians, size", "forward, ms", "backward, ms", "both, ms", "pairs that count", "floor, ms",
            "times the floor", "times the floor of what is walked", "first call, s (compiled before)",
            "colour error, max", "gradient error")  # fmt: skip
    lines = []
    for row in rows:
        ms, error = row["kernel_ms"], row["piece_error"]
        lines.append(
            (
                f"{row['gaussians']:,}, {row['size']}²",
                *(f"{ms[key]:.1f}" for key in ("forward", "backward", "both")),
                f"{row['evaluations'] / 1e6:.1f} M",
                f"{sum(row['floor_ms'].values()):.1f}",
                f"{row['times_the_floor']:.1f}",
                f"{row['times_the_floor'] * row['evaluations'] / row['lanes']:.1f}",
                f"{row['first_call_s']:.1f} ({row['cached_first_call_s']:.1f})",
                f"{error['colour_max']:.0e}",
                f"{max(error['gradients'].values()):.0e}",
            )
        )
    piece = rows[0]
    ratio = piece["piece_reference_ms"]["both"] / piece["piece_kernel_ms"]["both"]
    text = (
        f"The floor counts {splat.OPERATIONS['forward']} vector instructions forward and "
        f"{splat.OPERATIONS['backward']} backward for each pixel and Gaussian of α ≥ 1/255, at the "
        f"{piece['multiply_adds_per_second'] / 1e9:.0f} billion multiply-adds a second that the machine was seen to "
        f"reach. The kernel walks {piece['lanes'] / piece['evaluations']:.1f} pairs for each that counts, since rows "
        f"are 16 wide; the rest is projection, dealing and memory. On {piece['piece']['gaussians']:,} Gaussians at "
        f"{piece['piece']['size']}² it is {ratio:.0f} times as fast as the plain torch reference."
    )
    if "against" in piece:
        against = piece["against"]
        text += (
            f" Revision `{against['revision']}` took {against['then_ms']:.1f} ms where this one took "
            f"{against['now_ms']:.1f} in the same run, {against['times_faster']:.2f} times as long."
        )
    return markdown(head, lines) + "\n\n" + text


def full(count: int, size: int, against: str | None) -> Row:
    command = [sys.executable, splat.__file__, f"--gaussians={count}", f"--size={size}", "--json"]
    command += ["--against", against] if against else []
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def page(results: Row, command: str, picture: str) -> str:
    """docs/splatter.md."""
    scaling_text = [
        f"**{name}**, slope {slope(rows):.2f}\n\n"
        + markdown(
            ("", *(f"{row['x']:,}" for row in rows)),
            [
                ("ms, both", *(f"{row['ms']:.1f}" for row in rows)),
                ("MB", *(f"{row['mb']:.0f}" for row in rows)),
            ],
        )
        for name, rows in results["scaling"].items()
    ]
    knob_text = [
        markdown(
            (name, "ms, both", "error, max", "error, mean"),
            [
                (
                    f"**{row['value']}**" if row["default"] else row["value"],
                    f"{row['ms']:.1f}",
                    f"{row['max']:.1e}",
                    f"{row['mean']:.1e}",
                )
                for row in rows
            ],
        )
        for name, rows in results["knobs"].items()
    ]
    return TEMPLATE.format(
        command=command,
        machine=results["standing"][0]["machine"],
        standing=standing(results["standing"]),
        scaling="\n\n".join(scaling_text),
        knobs="\n\n".join(knob_text),
        picture=picture,
        reading=READING,
        piece=PIECE,
        piece_gaussians=PIECE_GAUSSIANS,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here, and its figure into images/ beside it")
    parser.add_argument("--against", metavar="REVISION", help="an earlier revision to compare with")
    parser.add_argument("--json", type=Path, help="write the results here")
    options = parser.parse_args()
    standing_rows = [full(50_000, 512, options.against), full(10_000, 256, None)]
    results: Row = {"standing": standing_rows, "scaling": scaling(), "knobs": knobs()}
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    if options.write:
        picture = options.write.parent / "images" / "splatter.svg"
        picture.parent.mkdir(exist_ok=True)
        plot(results["scaling"], results["knobs"], picture)
        command = " ".join(["python", "benchmarks/splat_curves.py", *sys.argv[1:]])
        options.write.write_text(page(results, command, f"images/{picture.name}"))


if __name__ == "__main__":
    main()
