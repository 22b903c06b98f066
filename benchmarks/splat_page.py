"""docs/splatter.md and its figure, from what benchmarks/splat_curves.py measured."""

from pathlib import Path
from typing import Any

import splat
from common.output import markdown
from querysplat_cli.runtime.figures import new_figure, save_figure
from splat_kernel import Scale

import numpy as np

PIECE = Scale(3125, 128)
"""What the error of the knobs is measured on."""
READING = """The two cut-offs are those of 3DGS, so that a scene looks the same in every viewer. The curves support
them. At α = 1/255 the largest error is about one step of 8 bits. A coarser cut-off doubles the error and saves a few
hundredths of the time. A finer one costs as little and shows in no picture. An earlier stop saves next to nothing until
it is visible, and a later stop changes nothing. The tile changes no pixel, and neighbouring sizes differ by no more
than repeated runs do. float32 adds little error: against the same cut-offs in float64 it is the "colour error" of the
first table, a ten-thousandth of the error of the α cut-off."""
Row = dict[str, Any]
TEMPLATE = """# The splatter's time, memory and error

Made by

    {command}

on {machine}.

Scenes are random. Gaussians of about 8 px (3 standard deviations) and opacities of 0.05 to 0.95 fill the picture. The
times include everything from centres and spherical harmonics to pixels, and the way back. Milliseconds are medians on a
virtual machine that shares its processor with others: repeated runs differ by a tenth.

## Where it stands

{standing}

## Scaling

{scaling}

The slopes are those of time over the larger half of each range, in log–log scale; 1 is linear. Memory grows by the rows
of the Gaussians (64 bytes, 64 more for each thread backward, and their gradients), by 4 bytes for each pair of tile and
Gaussian, and by 20 bytes for each pixel of each view.

## Error against time

The error is the largest and the mean difference of colour from blending in float64 without any cut-off, on
{piece_gaussians:,} Gaussians in {piece} × {piece} pixels. A colour spans 0 to 1. **Bold** is the default.

{knobs}

{reading}

![scaling and knobs]({picture})
"""


def page(results: Row, command: str, picture: str) -> str:
    """The text of docs/splatter.md; `picture` is the figure's address from there."""
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
        piece=PIECE.size,
        piece_gaussians=PIECE.gaussians,
    )


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


def standing(rows: list[Row]) -> str:
    """Runs of splat.py as a table, and what the first of them says in words."""
    head = ("Gaussians, size", "forward, ms", "backward, ms", "both, ms", "pairs that count", "floor, ms",
            "times the floor", "times the floor of all computed pairs", "first call, s (compiled before)",
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
        f"{splat.OPERATIONS['backward']} backward for each pixel and Gaussian with α ≥ 1/255, at the "
        f"{piece['multiply_adds_per_second'] / 1e9:.0f} billion multiply-adds a second that the machine reaches. The "
        f"kernel computes {piece['lanes'] / piece['evaluations']:.1f} pairs for each that counts, since it "
        f"blends 8 × 2 at a time. The rest of the time goes to projection, to the tiles' lists, and to memory. On "
        f"{piece['piece']['gaussians']:,} Gaussians at {piece['piece']['size']}² the kernel is {ratio:.0f} times as "
        f"fast as the plain torch reference."
    )
    if "against" in piece:
        against = piece["against"]
        text += (
            f" Revision `{against['revision']}` took {against['then_ms']:.1f} ms where this one took "
            f"{against['now_ms']:.1f} in the same run, {against['times_faster']:.2f} times as long."
        )
    return markdown(head, lines) + "\n\n" + text


def slope(rows: list[Row]) -> float:
    """Of log time over log x, in the larger half."""
    half = rows[len(rows) // 2 :]
    x, ms = (np.log([row[key] for row in half]) for key in ("x", "ms"))
    return float(np.polyfit(x, ms, 1)[0])
