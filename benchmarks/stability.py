"""The splatter on stiff and extreme scenes: error, gradient error and time of every case, and error against κ.

    python benchmarks/stability.py [--write docs/stability.md] [--json]

Each case is rendered by the compiled kernel in float32 and by the reference in float64, on the same inputs,
rounded to float32. `image` is the largest difference of colour or alpha, `gradient` the largest relative L2
difference of the gradient of a random linear functional of both pictures with respect to any of the
five parameters. A case that does not hold is written down as failed, and the program exits with 1.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numba
import torch
from torch import Tensor

import stiff_steps
from querysplat_cli.reporting.report import machine
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import RenderSettings, render
from scenes import FIELDS, camera, cloud, single, stacked

IMAGE, GRADIENT = 1e-5, 1e-4
"""What a case must keep unless it says otherwise, with the reason in its `note`."""
POISON = (0.0, -0.0, 1e-45, -1e-45, 1e-40, -1e-40, 1e-38, -1e-38, 1e-20, -1e-20, 1e-6, -1e-6, 1.0, -1.0, 1e6, -1e6,
          1e20, -1e20, 3.4e38, -3.4e38, math.nan, math.inf, -math.inf)  # fmt: skip
SWEPT = ("κ", "image, kernel", "gradient, kernel", "image, plain float32", "gradient, plain float32")
TEMPLATE = """# Stiff and extreme scenes

Made by

    {command}

on {machine}. {held} of {count} cases hold.

The compiled kernel works on float32 numbers; the reference does the same equations in float64, on the same inputs.
*image* is the largest difference of colour or alpha, *gradient* the largest relative L2 difference of any parameter's
gradient (relative to 1e-9 of the largest where it is next to nothing), *flips* the share of pixels in which an alpha
at the cut-off 1/255 fell to either side (they differ by at most two steps of 1/255), *ms* forward and backward
together, the first call left out. A case holds at an image error of {image:g} and a gradient error of {gradient:g}
unless the program says otherwise. *nothing*: culled, and every gradient exactly 0. *refuse*: one clear message.

| row | case | expected | image | gradient | flips | ms | holds | |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{table}

Rows that are no single scene are tests. In `tests/splat`: the reference's gradient against finite differences, one α
for both passes (37), fresh buffers filled with NaN (42), half-precision inputs (45), poison by hypothesis (46), SSIM
(30). In `tests/scene`: angles (44), alignments and rotations (21, 26), interrupted files (35). In `tests/encoders`:
photos (22 to 25). In `tests/model` and `tests/tto`: heads (27), rates that are too large (32).

## Error against κ

κ is the ratio between the largest and the smallest scale that one computation must carry: the length of a needle over
its thickness, the distance from the origin over the size of the scene, the number of blended Gaussians. Dotted: the
same equations in plain float32, by torch. The kernel projects in float64, relative to the camera, blends in float32,
and keeps the conic as a triangular factor, so that a needle's terms do not cancel.

![error against κ]({picture})
{sweeps}

## Optimisation against κ

{steps_note}

{steps}
"""
NEXT_TO_NOTHING = 1e-9
KAPPAS = [10.0**k for k in range(9)]
SQUARE = math.sqrt(0.5)
TURNS = {"across the view": [1.0, 0, 0, 0], "along the view": [SQUARE, 0, SQUARE, 0], "askew": [0.8, 0.1, -0.3, 0.5]}


@dataclass(frozen=True)
class Case:
    """One scene. `expect`: agree; nothing (culled, and every gradient exactly 0); refuse. `flips` is the share of
    pixels that may differ by up to two steps of 1/255, because an alpha at the cut-off falls to either side."""

    row: str
    what: str
    gaussians: Gaussians
    cameras: Cameras
    expect: str = "agree"
    image: float = IMAGE
    gradient: float = GRADIENT
    flips: float = 0.0
    note: str = ""
    settings: RenderSettings = field(default_factory=RenderSettings)


@dataclass(frozen=True)
class Measured:
    row: str
    what: str
    expect: str
    image: float | None
    flipped: float | None
    gradient: float | None
    milliseconds: float | None
    holds: bool
    note: str


def changed(cameras: Cameras, **entries: float) -> Cameras:
    """`cameras` with other fx, fy, cx or cy."""
    K = cameras.K.clone()
    for name, value in entries.items():
        K[:, int(name[1] == "y"), 2 if name[0] == "c" else int(name[1] == "y")] = value
    return replace(cameras, K=K)


def away(gaussians: Gaussians, cameras: Cameras, distance: float) -> tuple[Gaussians, Cameras]:
    """Scene and camera moved together, `distance` along each axis."""
    shift = torch.full((3,), distance, dtype=torch.float64)
    w2c = cameras.w2c.clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ shift
    return replace(gaussians, means=gaussians.means + shift), replace(cameras, w2c=w2c)


def sized(gaussians: Gaussians, scale: float) -> tuple[Gaussians, RenderSettings]:
    """The scene `scale` times as large, seen from the same place with near and far planes to match."""
    near, far = RenderSettings.near * scale, RenderSettings.far * scale
    grown = replace(gaussians, means=gaussians.means * scale, scales=gaussians.scales * scale)
    return grown, RenderSettings(near=near, far=far)


def cases() -> Iterator[Case]:
    """The rows of the table, numbered as in docs/reference/stability-cases.md."""
    small = camera(24, 32)
    for length in (1e-20, 1e20):
        turned = single(quats=[0.5 * length, -0.5 * length, 0.1 * length, 0.7 * length], scales=[0.5, 0.1, 0.02])
        yield Case("1", f"quaternion of length {length:g}", turned, small)
    yield Case("1, 40", "quaternion of length 0", single(quats=[0.0] * 4), small, "nothing")
    for name, turn in TURNS.items():
        needle = single(quats=turn, scales=[1.0, 1e-4, 1e-8])
        yield Case("2", f"needle 1 : 1e-4 : 1e-8, {name}", needle, camera(48, 48), gradient=2e-4)
    yield Case("3", "disc seen edge-on, thickness 1e-7", single(
        quats=TURNS["along the view"], scales=[0.5, 0.5, 1e-7]), small)  # fmt: skip
    yield Case("4", "1e12 times the picture", single(scales=[1e12] * 3), small)
    yield Case("4", "a speck of 1e-12", single(scales=[1e-12] * 3), small)
    for z, place in ((0.0, "at the camera"), (1e-7, "1e-7 before it"), (-3.0, "behind it"), (126.0, "beyond far")):
        yield Case("5", f"centre {place}", single(means=[0.0, 0, z]), small, "nothing")
    yield Case("5", "centre on the near plane", single(means=[0.0, 0, 0.025], scales=[0.0025] * 3), small)
    wide = changed(camera(32, 32, field_of_view=120), cx=3.2)
    scene = cloud(60, 60, wide, pixels=4.0)
    scene.means[:, :2] *= 2.5
    yield Case("6, 41", "far off-axis, 120°, cx at 0.1", scene, wide, gradient=1e-3, flips=0.005)
    for opacity in (1 / 255, 1 - 1e-9, 1.0):
        yield Case("7", f"opacity {opacity:.10g}", single(opacities=opacity), small, note="capped at 0.99", flips=1.0)
    for opacity in (0.0, 1 / 256):
        yield Case("7, 36", f"opacity {opacity:.4g}", single(opacities=opacity), small, "nothing")
    pixel = camera(1, 1)
    yield Case("8, 37", "10,000 opaque on one pixel", cloud(10_000, 10_000, pixel, opacity=(0.9, 1), pixels=1), pixel,
               flips=1.0, gradient=1e-3)  # fmt: skip
    faint = cloud(10_000, 10_000, pixel, opacity=(1 / 254, 1 / 250), pixels=30)
    yield Case("9", "10,000 of opacity 1/254 to 1/250 on one pixel", faint, pixel, flips=1.0, gradient=5e-3)
    pair = stacked(single(sh=[[1.0, -2, -2]]), single(sh=[[-2.0, -2, 1]]))
    yield Case("10", "equal depths keep their given order", pair, small)
    yield Case("11", "no Gaussians", cloud(0, 0, small), small, "nothing")
    yield Case("11", "none in view", single(means=[0.0, 50, 3]), small, "nothing")
    for height, width in ((1, 1), (17, 33), (4096, 8)):
        odd = camera(height, width)
        scene, what = cloud(100, 100, odd, pixels=3), f"{height} × {width} pixels"
        if height < 4096:
            yield Case("12", what, scene, odd, flips=0.002, gradient=1e-3)
        else:
            note = "float32 tells pixel 4,096 to 1/4,096 px"
            yield Case("12", what, scene, odd, flips=0.005, gradient=1e-3, note=note)
    for angle in (1.0, 170.0):
        seen = camera(24, 32, field_of_view=angle)
        yield Case("13", f"field of view {angle:g}°", cloud(80, 80, seen), seen, flips=0.003, gradient=1e-3)
    odd = changed(small, cx=40.0, fy=0.6 * float(small.K[0, 1, 1]))
    yield Case("13", "principal point outside, fx ≠ fy", cloud(150, 150, odd), odd, flips=0.003, gradient=1e-3)
    distant = away(cloud(60, 60, small), small, 1e6)
    yield Case("14", "1e6 units from the origin", *distant, flips=0.005, gradient=1e-3)
    for scale in (1e-6, 1e6):
        grown, limits = sized(cloud(60, 60, small), scale)
        what = f"scene of size {scale:g}"
        yield Case("15", what, grown, small, settings=limits, flips=0.005, gradient=1e-3)
    wild = stacked(single(sh=[[1e10, -1e10, 0]]), single())
    yield Case("16, 45", "SH of ±1e10 beside a sound one", wild, small, note="colours are clamped to [0, 1e6]")
    for value in (math.nan, math.inf):
        yield Case("17", f"{value} in a centre", single(means=[value, 0, 3.0]), small, "refuse")
    many = cloud(1_000_000, 1_000_000, pixel, pixels=0.5, opacity=(1 / 255, 0.02), degree=0)
    yield Case("18", "a million in one tile", many, pixel, flips=1.0, gradient=5e-3)
    yield Case("18", "a million that each cover 4,096 tiles", replace(
        many, scales=many.scales * 1e6, opacities=many.opacities * 0 + 0.9), camera(1024, 1024), "refuse")  # fmt: skip
    swap = stacked(single(sh=[[1.0, -2, -2]]), single(means=[0, 0, 3 + 1e-6], sh=[[-2.0, -2, 1]]))
    yield Case("20", "two at depths 1e-6 apart", swap, small)
    yield Case("38", "alpha in (0.99, 1)", single(opacities=0.995), small, note="no gradient through the cap")
    yield Case("39", "scale e⁴⁰", single(scales=[math.exp(40)] * 3), small)
    for text, scales in (("e⁴⁵", [math.exp(45)] * 3), ("0 along one axis", [0.3, 0, 0.3]), ("3e38", [3e38, 0.1, 0.1])):
        yield Case("39", f"scale {text}", single(scales=scales), small, "nothing")
    copies = stacked(*[single(opacities=0.01)] * 1000)
    yield Case("43", "a thousand copies of one Gaussian", copies, small, gradient=2e-4, note="gradients nearly cancel")


def outcome(case: Case, backend: str, dtype: torch.dtype) -> tuple[Tensor, list[Tensor], float]:
    """Colour and alpha [4, …], the gradients, and the milliseconds of both passes."""
    leaves = case.gaussians.map(lambda field: field.to(dtype, copy=True).requires_grad_())
    generator = torch.Generator().manual_seed(0)
    start = time.perf_counter()
    found = render(leaves, case.cameras, backend=backend, settings=case.settings)
    picture = torch.cat([found.colour, found.alpha[:, None]], 1)
    slope = torch.randn(picture.shape, generator=generator, dtype=torch.float64).to(dtype)
    gradients = torch.autograd.grad(picture, [getattr(leaves, name) for name in FIELDS], slope, allow_unused=True)
    seconds = time.perf_counter() - start
    filled = [torch.zeros(0, dtype=dtype) if gradient is None else gradient for gradient in gradients]
    return picture.detach().double(), [gradient.double() for gradient in filled], 1e3 * seconds


def relative(case: Case, found: list[Tensor], exact: list[Tensor]) -> float:
    """The largest relative L2 error of a parameter's gradient.

    Where all of a gradient is next to nothing, such as that of a sphere's rotation, its error is relative to
    `NEXT_TO_NOTHING` of what the other parameters can change, each by its own size.
    """
    sizes = [float(getattr(case.gaussians, name).norm().clamp_min(1e-300)) for name in FIELDS]
    norms = [float(two.norm()) for two in exact]
    least = NEXT_TO_NOTHING * max(size * norm for size, norm in zip(sizes, norms, strict=True))
    return max(
        float((one - two).norm()) / max(norm, least / size, 1e-300)
        for one, two, norm, size in zip(found, exact, norms, sizes, strict=True)
    )


def rounded(case: Case) -> Case:
    """The case with its numbers rounded to float32, as both renderers get them."""
    return replace(case, gaussians=case.gaussians.to(torch.float32).to(torch.float64))


def measure(case: Case) -> Measured:
    case = rounded(case)

    def row(holds: bool, note: str, *numbers: float | None) -> Measured:
        return Measured(case.row, case.what, case.expect, *(numbers or (None,) * 4), holds=holds, note=note)

    if case.expect == "refuse":
        try:
            render(case.gaussians.to(torch.float32), case.cameras)
        except QuerySplatError as error:
            return row(True, error.message)
        return row(False, "was not refused")
    picture, gradients, _ = outcome(case, "cpu", torch.float32)
    runs = 5 if len(case.gaussians) < 100_000 else 1
    milliseconds = statistics.median(outcome(case, "cpu", torch.float32)[2] for _ in range(runs))
    if not all(bool(tensor.isfinite().all()) for tensor in (picture, *gradients)):
        return row(False, "not finite", None, None, None, milliseconds)
    if case.expect == "nothing":
        silent = not picture.any() and not any(bool(gradient.any()) for gradient in gradients)
        return row(silent, case.note, 0.0 if silent else float(picture.abs().max()), 0.0, 0.0, milliseconds)
    exact, exact_gradients, _ = outcome(case, "reference", torch.float64)
    difference = (picture - exact).abs() / exact.abs().clamp_min(1)
    flipped = float((difference > IMAGE).double().mean())
    image, gradient = float(difference.max()), relative(case, gradients, exact_gradients)
    holds = gradient <= case.gradient and flipped <= case.flips
    holds &= image <= (max(case.image, 2 / 255) if case.flips else case.image)
    return row(bool(holds), case.note, image, flipped, gradient, milliseconds)


def threads() -> Measured:
    """Pictures from one thread and from all have the same bits, as have gradients of the same number of threads."""
    case = rounded(Case("19", "", cloud(3000, 3000, camera(240, 320)), camera(240, 320)))
    every = outcome(case, "cpu", torch.float32)
    again = outcome(case, "cpu", torch.float32)
    numba.set_num_threads(1)
    one = outcome(case, "cpu", torch.float32)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    same = torch.equal(every[0], one[0]) and all(map(torch.equal, every[1], again[1]))
    what = f"one thread and {numba.config.NUMBA_NUM_THREADS}: the same picture; twice the same gradient"
    note = "gradients of different thread counts are summed in another order"
    return Measured(
        "19", what, "agree", 0.0 if same else math.nan, 0.0, relative(case, one[1], every[1]), one[2], same, note
    )


def poison() -> Measured:
    """Every poison value in every field of one Gaussian of twelve. Finite ones must leave all results finite."""
    small, held, tried = camera(12, 12), 0, 0
    for name in FIELDS:
        for value in POISON:
            scene = rounded(Case("46", "", cloud(12, 12, small, degree=0), small)).gaussians.to(torch.float32)
            getattr(scene, name)[5] = value
            case = Case("46", "", scene, small)
            tried += 1
            try:
                picture, gradients, _ = outcome(case, "cpu", torch.float32)
                held += math.isfinite(value) and all(bool(tensor.isfinite().all()) for tensor in (picture, *gradients))
            except QuerySplatError:
                held += not math.isfinite(value)
    what = f"{len(POISON)} poison values in each of {len(FIELDS)} fields: finite, or refused by name"
    return Measured("46", what, "agree", None, None, None, None, held == tried, f"{held} of {tried} held")


def sweeps() -> dict[str, dict[str, list[float]]]:
    """Image and gradient error of the kernel, and of the same equations in plain float32, against κ."""
    square = camera(48, 48)
    curves: dict[str, list[tuple[float, Case]]] = {
        f"needle {name}": [
            (kappa, Case("", "", single(quats=turn, scales=[1.0, kappa**-0.5, 1 / kappa]), square)) for kappa in KAPPAS
        ]
        for name, turn in TURNS.items()
    }
    detail = cloud(60, 60, camera(24, 32))
    curves["distance from the origin"] = [
        (kappa, Case("", "", *away(detail, camera(24, 32), kappa))) for kappa in KAPPAS
    ]
    pixel = camera(1, 1)
    curves["Gaussians on one pixel"] = [
        (float(count), Case("", "", cloud(count, count, pixel, opacity=(1 / 250, 1 / 240), pixels=30), pixel))
        for count in (1, 10, 100, 1000, 10_000, 100_000)
    ]
    result = {}
    for name, curve in curves.items():
        columns: dict[str, list[float]] = {key: [] for key in SWEPT}
        for kappa, case in curve:
            exact = outcome(rounded(case), "reference", torch.float64)
            found = [outcome(rounded(case), backend, torch.float32) for backend in ("cpu", "reference")]
            errors = [float((one[0] - exact[0]).abs().max()) for one in found]
            slopes = [relative(rounded(case), one[1], exact[1]) for one in found]
            for key, value in zip(SWEPT, (kappa, errors[0], slopes[0], errors[1], slopes[1]), strict=True):
                columns[key].append(value)
        result[name] = columns
    return result


def plot(curves: dict[str, dict[str, list[float]]], path: Path) -> None:
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


def number(value: float | None) -> str:
    return "" if value is None else "0" if value == 0 else f"{value:.1e}"


def document(
    rows: list[Measured],
    curves: dict[str, dict[str, list[float]]],
    optimised: list[stiff_steps.Row],
    command: str,
    picture: str,
) -> str:
    """The text of docs/stability.md."""
    table = [
        f"| {row.row} | {row.what} | {row.expect} | {number(row.image)} | {number(row.gradient)} | "
        f"{'' if not row.flipped else f'{row.flipped:.1%}'} | "
        f"{'' if row.milliseconds is None else f'{row.milliseconds:.2g}'} | "
        f"{'yes' if row.holds else '**failed**'} | {row.note} |"
        for row in rows
    ]
    sweeps_text = []
    for name, columns in curves.items():
        sweeps_text += [f"\n**{name}**\n", "| " + " | ".join(SWEPT) + " |", "| --- " * len(SWEPT) + "|"]
        sweeps_text += [
            "| " + " | ".join(number(v) for v in line) + " |" for line in zip(*columns.values(), strict=True)
        ]
    held = sum(row.holds for row in rows)
    return TEMPLATE.format(
        command=command,
        machine=machine(),
        held=held,
        count=len(rows),
        table="\n".join(table),
        sweeps="\n".join(sweeps_text),
        picture=picture,
        image=IMAGE,
        gradient=GRADIENT,
        steps_note=stiff_steps.NOTE,
        steps=stiff_steps.table(optimised),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here, and its figure into images/ beside it")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = sorted([measure(case) for case in cases()] + [threads(), poison()], key=lambda r: int(r.row.split(",")[0]))
    for row in rows:
        if not row.holds:
            print(f"failed: {row}", file=sys.stderr)
    if options.write or options.json:
        curves, optimised = sweeps(), stiff_steps.measured()
    if options.json:
        found = {"cases": rows, "optimised": optimised}
        tables = {name: [asdict(row) for row in some] for name, some in found.items()}
        print(json.dumps({"machine": machine(), "curves": curves, **tables}, indent=2))
    if options.write:
        picture = options.write.parent / "images" / "stability.svg"
        picture.parent.mkdir(exist_ok=True)
        plot(curves, picture)
        command = f"python benchmarks/stability.py --write {options.write}"
        options.write.write_text(document(rows, curves, optimised, command, f"images/{picture.name}"))
    print(f"{sum(row.holds for row in rows)} of {len(rows)} cases hold", file=sys.stderr)
    sys.exit(not all(row.holds for row in rows))


if __name__ == "__main__":
    main()
