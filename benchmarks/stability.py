"""The splatter on stiff and extreme scenes: error, gradient error and time of every case, and error against κ.

    python benchmarks/stability.py [--write docs/stability.md] [--json]

The compiled kernel renders each case in float32, and the reference renders it in float64. Both read the same numbers,
rounded to float32. `image` is the largest difference of colour or alpha. `gradient` compares the gradients of a random
linear functional of both pictures; it is the largest relative L2 difference of those of the five parameters. A case
that does not hold is written down as failed, and the exit code is then 1.
"""

import argparse
import json
import math
import statistics
import sys
import time
from dataclasses import asdict
from pathlib import Path

import stiff_steps
from common.output import machine
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.splat.render import render
from scenes import FIELDS, camera, cloud, single
from stability_cases import IMAGE, TURNS, Case, away, cases, rounded
from stability_page import SWEPT, Curves, Measured, page, plot

import numba
import torch
from torch import Tensor

POISON = (0.0, -0.0, 1e-45, -1e-45, 1e-40, -1e-40, 1e-38, -1e-38, 1e-20, -1e-20, 1e-6, -1e-6, 1.0, -1.0, 1e6, -1e6,
          1e20, -1e20, 3.4e38, -3.4e38, math.nan, math.inf, -math.inf)  # fmt: skip
NEXT_TO_NOTHING = 1e-9
"""The share of the largest gradient below which another counts as zero."""
KAPPAS = [10.0**k for k in range(9)]


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

    Some gradients are next to nothing, such as that of the rotation of a sphere. Their error is relative to
    `NEXT_TO_NOTHING` of the largest product of a parameter's size and its gradient's.
    """
    sizes = [float(getattr(case.gaussians, name).norm().clamp_min(1e-300)) for name in FIELDS]
    norms = [float(two.norm()) for two in exact]
    least = NEXT_TO_NOTHING * max(size * norm for size, norm in zip(sizes, norms, strict=True))
    return max(
        float((one - two).norm()) / max(norm, least / size, 1e-300)
        for one, two, norm, size in zip(found, exact, norms, sizes, strict=True)
    )


def measure(case: Case) -> Measured:
    case = rounded(case)

    def row(holds: bool, note: str, *numbers: float | None) -> Measured:
        return Measured(case.family, case.what, case.expect, *(numbers or (None,) * 4), holds=holds, note=note)

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
        empty = not picture.any() and not any(bool(gradient.any()) for gradient in gradients)
        return row(empty, case.note, 0.0 if empty else float(picture.abs().max()), 0.0, 0.0, milliseconds)
    exact, exact_gradients, _ = outcome(case, "reference", torch.float64)
    difference = (picture - exact).abs() / exact.abs().clamp_min(1)
    flipped = float((difference > IMAGE).double().mean())
    image, gradient = float(difference.max()), relative(case, gradients, exact_gradients)
    holds = gradient <= case.gradient and flipped <= case.flips
    holds &= image <= (max(case.image, 2 / 255) if case.flips else case.image)
    return row(bool(holds), case.note, image, flipped, gradient, milliseconds)


def threads() -> Measured:
    """The same picture from one thread and from all; the same gradients from as many threads."""
    cameras = camera(240, 320)
    case = rounded(Case("threads", "", cloud(3000, 3000, cameras), cameras))
    every = outcome(case, "cpu", torch.float32)
    again = outcome(case, "cpu", torch.float32)
    numba.set_num_threads(1)
    one = outcome(case, "cpu", torch.float32)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    same = torch.equal(every[0], one[0]) and all(map(torch.equal, every[1], again[1]))
    what = f"the same picture from 1 and from {numba.config.NUMBA_NUM_THREADS}; the same gradient twice"
    note = "another number of threads sums gradients in another order"
    image, gradient = 0.0 if same else math.nan, relative(case, one[1], every[1])
    return Measured(case.family, what, case.expect, image, 0.0, gradient, one[2], same, note)


def poison() -> Measured:
    """Every poison value in every field of one Gaussian of twelve: what a finite one leads to must be finite."""
    small, held, tried = camera(12, 12), 0, 0
    for name in FIELDS:
        for value in POISON:
            scene = cloud(12, 12, small, degree=0).to(torch.float32)
            getattr(scene, name)[5] = value
            tried += 1
            try:
                picture, gradients, _ = outcome(Case("", "", scene, small), "cpu", torch.float32)
                held += math.isfinite(value) and all(bool(tensor.isfinite().all()) for tensor in (picture, *gradients))
            except QuerySplatError:
                held += not math.isfinite(value)
    what = f"{len(POISON)} poison values in each of {len(FIELDS)} fields: finite, or refused by name"
    none = (None,) * 4
    return Measured("range of numbers", what, "agree", *none, holds=held == tried, note=f"{held} of {tried} held")


def sweeps() -> Curves:
    """Image and gradient error of the kernel, and of the same equations in plain float32, against κ."""
    return {name: _swept(curve) for name, curve in _curves().items()}


def _curves() -> dict[str, list[tuple[float, Case]]]:
    square, small, pixel = camera(48, 48), camera(24, 32), camera(1, 1)
    curves = {
        f"needle {name}": [
            (kappa, Case("", "", single(quats=turn, scales=[1.0, kappa**-0.5, 1 / kappa]), square)) for kappa in KAPPAS
        ]
        for name, turn in TURNS.items()
    }
    detail = cloud(60, 60, small)
    curves["distance from the origin"] = [(kappa, Case("", "", *away(detail, small, kappa))) for kappa in KAPPAS]
    curves["Gaussians on one pixel"] = [
        (float(count), Case("", "", cloud(count, count, pixel, opacity=(1 / 250, 1 / 240), pixels=30), pixel))
        for count in (1, 10, 100, 1000, 10_000, 100_000)
    ]
    return curves


def _swept(curve: list[tuple[float, Case]]) -> dict[str, list[float]]:
    columns: dict[str, list[float]] = {key: [] for key in SWEPT}
    for kappa, case in curve:
        exact = outcome(rounded(case), "reference", torch.float64)
        found = [outcome(rounded(case), backend, torch.float32) for backend in ("cpu", "reference")]
        errors = [float((one[0] - exact[0]).abs().max()) for one in found]
        slopes = [relative(rounded(case), one[1], exact[1]) for one in found]
        for key, value in zip(SWEPT, (kappa, errors[0], slopes[0], errors[1], slopes[1]), strict=True):
            columns[key].append(value)
    return columns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here, and its figure into images/ beside it")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [*map(measure, cases()), threads(), poison()]
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
        options.write.write_text(page(rows, curves, optimised, command, f"images/{picture.name}"))
    print(f"{sum(row.holds for row in rows)} of {len(rows)} cases hold", file=sys.stderr)
    sys.exit(not all(row.holds for row in rows))


if __name__ == "__main__":
    main()
