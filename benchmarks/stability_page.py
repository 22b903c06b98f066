"""docs/stability.md and its figure, from what benchmarks/stability.py measured."""

import math
from dataclasses import dataclass
from pathlib import Path

import stiff_steps
from common.output import machine, markdown
from querysplat_cli.runtime.figures import new_figure, save_figure
from stability_cases import GRADIENT, IMAGE

SWEPT = ("κ", "image, kernel", "gradient, kernel", "image, plain float32", "gradient, plain float32")
Curves = dict[str, dict[str, list[float]]]
"""Columns of `SWEPT`, by what is swept."""
HEAD = ("family", "case", "expected", "image", "gradient", "flips", "ms", "holds", "")
TEMPLATE = """# Stiff and extreme scenes

Made by

    {command}

on {machine}. {held} of {count} cases hold. [The list of cases](reference/stability-cases.md) states what is required of
each, and names the tests.

The compiled kernel works on float32 numbers. The reference solves the same equations in float64, on the same inputs.

- *image*: the largest difference of colour or alpha.
- *gradient*: the largest relative L2 difference of the gradient of any parameter. Where a gradient is next to nothing,
  the difference is relative to 1e-9 of the largest one.
- *flips*: the share of pixels in which an alpha at the cut-off 1/255 fell to either side. Such pixels differ by at most
  two steps of 1/255.
- *ms*: forward and backward together, without the first call.
- *expected*: "agree" with the reference; "nothing", which means that everything is culled and every gradient is exactly
  0; or "refuse", with a message that names the tensor or the limit.

A case holds at an image error of {image:g} and a gradient error of {gradient:g} unless the program states others.

{table}

Some cases are not a single scene. They are tests:

- `tests/splat`: finite differences against the gradient of the reference, one α for both passes, fresh buffers filled
  with NaN, half-precision inputs, random poison values, SSIM.
- `tests/scene`: angles, alignments and rotations, interrupted files.
- `tests/encoders`: photos that do not make a scene.
- `tests/model` and `tests/tto`: extreme activations, learning rates that are too large.

## Error against κ

κ is the ratio between the largest and the smallest scale in one computation: the length of a needle over its
thickness, the distance from the origin over the size of the scene, or the number of blended Gaussians. Dotted lines
are the same equations in plain float32, by torch. The kernel projects in float64, relative to the camera, and blends in
float32. It keeps the conic as a triangular factor, so the terms of a needle do not cancel.

![error against κ]({picture})

{sweeps}

## Optimisation against κ

{steps_note}

{steps}
"""


@dataclass(frozen=True)
class Measured:
    """One line of the table; None where there is nothing to measure."""

    family: str
    what: str
    expect: str
    image: float | None
    flipped: float | None
    gradient: float | None
    milliseconds: float | None
    holds: bool
    note: str


def plot(curves: Curves, path: Path) -> None:
    figure = new_figure(3.6 * len(curves), 3.4)
    axes = figure.subplots(1, len(curves), sharey=True)
    for axis, (name, columns) in zip(axes, curves.items(), strict=True):
        for key, style in zip(SWEPT[1:], ("C0-", "C1-", "C0:", "C1:"), strict=True):
            finite = [value if math.isfinite(value) else math.nan for value in columns[key]]
            axis.loglog(columns["κ"], [max(value, 1e-9) for value in finite], style, label=key, marker=".")
        axis.axhline(IMAGE, color="0.8", zorder=0)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("κ")
    axes[0].set_ylabel("error against float64")
    axes[0].legend(fontsize=7)
    save_figure(figure, path)


def page(rows: list[Measured], curves: Curves, optimised: list[stiff_steps.Row], command: str, picture: str) -> str:
    """The text of docs/stability.md; `picture` is the figure's address from there."""
    sweeps = [
        f"**{name}**\n\n" + markdown(SWEPT, [tuple(map(_number, line)) for line in zip(*columns.values(), strict=True)])
        for name, columns in curves.items()
    ]
    return TEMPLATE.format(
        command=command,
        machine=machine(),
        held=sum(row.holds for row in rows),
        count=len(rows),
        table=markdown(HEAD, [_cells(row) for row in rows]),
        sweeps="\n\n".join(sweeps),
        picture=picture,
        image=IMAGE,
        gradient=GRADIENT,
        steps_note=stiff_steps.NOTE,
        steps=stiff_steps.table(optimised),
    )


def _cells(row: Measured) -> tuple[str, ...]:
    return (
        row.family,
        row.what,
        row.expect,
        _number(row.image),
        _number(row.gradient),
        f"{row.flipped:.1%}" if row.flipped else "",
        "" if row.milliseconds is None else f"{row.milliseconds:.2g}",
        "yes" if row.holds else "**failed**",
        row.note,
    )


def _number(value: float | None) -> str:
    return "" if value is None else "0" if value == 0 else f"{value:.1e}"
