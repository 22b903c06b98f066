"""Time, memory and error of the CPU splatter on random Gaussians, beside the torch reference.

    python benchmarks/splat.py [--gaussians N] [--size S] [--radius PX] [--views V] [--degree D]
                               [--against REVISION] [--brief] [--json]

The scene and the times are those of benchmarks/splat_kernel.py. The reference runs on a smaller piece of the same
density, whose size is stated. The error of the kernel is measured against it. `--against` also times the kernel of an
earlier revision; the two take turns, in processes of their own.

The floor is the least time in which this machine could do the operations of the (pixel, Gaussian) pairs with
α ≥ 1/255, at the rate of fused multiply-adds that it reaches in a loop of nothing else.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from common.output import machine
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.compiled_blending import GROUPS, LANES, PAIRED, SLACK
from querysplat_cli.splat.compiled_tiles import HIGH, WIDE
from querysplat_cli.splat.render import render
from splat_kernel import ROOT, Scale, Timing, add_scale_options, both, in_tree, measure, random_scene, scale_of, timing

import numba
import numpy as np
import torch

TURNS = 5
"""Runs of either revision in a comparison."""
OPERATIONS = {"forward": 29, "backward": 47}
"""Vector instructions for one pixel and Gaussian, counted in `compiled_blending.py`.

α takes 18: 5 for the quadratic form, 2 bounds, 6 for the polynomial, 3 squarings, 2 for the cut-off. Transmittance and
the stop take 7 forward and 8 backward, the four sums 4. Backward adds 5 for the slope of the value, 1 for what lies
behind, 7 for the slope of σ, and 8 for the seven sums."""
PIECE = 64
"""Side of the piece that the reference renders, in pixels."""
FIRST_CALL = """
import sys, time
sys.path.insert(0, {folder!r})
start = time.perf_counter()
import splat_kernel as kernel
imported = time.perf_counter()
kernel.both(*kernel.random_scene(kernel.Scale(100, 32, 4.0, 1, 1)), "cpu")
print(time.perf_counter() - imported)
"""


@dataclass(frozen=True)
class Error:
    """Against the float64 reference: largest and mean error of the colour, relative L2 error of each gradient."""

    colour_max: float
    colour_mean: float
    gradients: dict[str, float]


@dataclass(frozen=True)
class Details:
    lanes: int
    evaluations: int
    evaluations_per_second: float
    multiply_adds_per_second: float
    floor_ms: dict[str, float]
    times_the_floor: float
    first_call_s: float
    cached_first_call_s: float
    piece: dict[str, int]
    piece_kernel_ms: Timing
    piece_reference_ms: Timing
    piece_error: Error


def error(gaussians: Gaussians, cameras: Cameras) -> Error:
    _, _, colour, gradients = both(gaussians, cameras, "cpu")
    _, _, exact_colour, exact = both(gaussians.to(torch.float64), cameras, "reference")
    difference = (colour - exact_colour).abs()
    names = ("means", "quats", "scales", "opacities", "sh")
    relative = [float((a - b).norm() / b.norm()) for a, b in zip(gradients, exact, strict=True)]
    return Error(float(difference.max()), float(difference.mean()), dict(zip(names, relative, strict=True)))


def work(gaussians: Gaussians, cameras: Cameras) -> tuple[int, int]:
    """Vector lanes that the kernel runs, and (pixel, Gaussian) pairs with α ≥ 1/255; early stops are not counted."""
    leaves = gaussians.map(lambda field: field.detach().clone().requires_grad_())
    blended = render(leaves, cameras, backend="cpu").colour.grad_fn
    while blended is not None and not hasattr(blended, "views"):
        blended = blended.next_functions[0][0]
    lanes = evaluations = 0
    tiles_x = -(-cameras.width // WIDE)
    for view in blended.views:  # type: ignore[union-attr]
        lengths = torch.from_numpy(view.starts).diff()
        tile = torch.arange(len(lengths)).repeat_interleave(lengths)
        rows = torch.from_numpy(view.rows)[torch.from_numpy(view.lists).long()]
        lanes += LANES * int(_groups(rows, tile % tiles_x * WIDE, tile // tiles_x * HIGH).sum())
        a, c, lost = (torch.from_numpy(view.rows)[:, column] for column in (2, 4, 5))
        seen = torch.from_numpy(view.rows)[:, 10] > 0
        evaluations += int((2 * math.pi * (math.log(255) - lost) / (a * c))[seen].sum())
    return lanes, evaluations


def _groups(rows: torch.Tensor, left: torch.Tensor, top: torch.Tensor) -> torch.Tensor:
    """How many groups of rows of its tile each Gaussian meets, as the kernel finds them."""
    a, b, q, half = (rows[:, column] for column in (2, 3, 4, 11))
    low = left + 0.5 - rows[:, 0]
    square = b * b + q * q
    reaches = []
    for sign in (1, -1):
        furthest = -sign * b / a * half
        x = furthest.clamp(low, low + WIDE - 1)
        chord = ((q * half).square() * square - (a * q * x).square()).clamp_min(0).sqrt() / square
        reaches.append(torch.where(x == furthest, half, chord - sign * a * b / square * x) + SLACK * (1 + half))
    under = rows[:, 1] - top - 0.5
    first = ((under - reaches[1]).ceil() / PAIRED).floor().clamp(0, GROUPS)
    last = ((under + reaches[0]) / PAIRED).floor() + 1
    return last.clamp_max(GROUPS).maximum(first) - first


def first_call(cache: str) -> float:
    """Seconds that the first picture and its gradient take in a fresh process."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    code = FIRST_CALL.format(folder=str(Path(__file__).resolve().parent))
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout)


@numba.njit(parallel=True, fastmath=True, error_model="numpy")
def _multiply_add(rounds: int, sums: np.ndarray) -> None:
    for thread in numba.prange(len(sums)):
        row = sums[thread]
        for _ in range(rounds):
            for lane in range(128):
                row[lane] = row[lane] * np.float32(0.999) + np.float32(0.001)


def multiply_adds_per_second() -> float:
    """Float32 fused multiply-adds that all threads together reach, each lane counted."""
    sums = np.zeros((numba.get_num_threads(), 128), np.float32)
    _multiply_add(1, sums)
    rounds, seconds = 2_000_000, []
    for _ in range(5):
        start = time.perf_counter()
        _multiply_add(rounds, sums)
        seconds.append(time.perf_counter() - start)
    return rounds * sums.size / min(seconds)


def details(scale: Scale, milliseconds: float) -> Details:
    """What the time of both passes is worth, and the piece beside the reference."""
    lanes, evaluations = work(*random_scene(scale))
    side = min(PIECE, scale.size)
    count = max(1, round(scale.gaussians * (side / scale.size) ** 2))
    piece = random_scene(replace(scale, gaussians=count, size=side, views=1))
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = first_call(cache), first_call(cache)
    rate = multiply_adds_per_second()
    floor = {name: 1e3 * evaluations * operations / rate for name, operations in OPERATIONS.items()}
    return Details(
        lanes=lanes,
        evaluations=evaluations,
        evaluations_per_second=evaluations / (1e-3 * milliseconds),
        multiply_adds_per_second=rate,
        floor_ms=floor,
        times_the_floor=milliseconds / sum(floor.values()),
        first_call_s=cold,
        cached_first_call_s=warm,
        piece={"gaussians": count, "size": side},
        piece_kernel_ms=timing(*piece, "cpu", 15),
        piece_reference_ms=timing(*piece, "reference", 2),
        piece_error=error(*piece),
    )


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A folder with the sources of `revision`."""
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", revision, "src"], cwd=ROOT, check=True, capture_output=True)
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        yield Path(folder)


def compare(revision: str, scale: Scale, repeats: int) -> dict[str, float]:
    """Median milliseconds of both passes here and at `revision`, and the ratio of the two."""
    with checked_out(revision) as tree:
        in_tree(tree, scale, repeats)  # compiles
        turns = [(in_tree(ROOT, scale, repeats), in_tree(tree, scale, repeats)) for _ in range(TURNS)]
    now, then = (statistics.median(turn[i]["kernel_ms"]["both"] for turn in turns) for i in (0, 1))
    return {"now_ms": now, "then_ms": then, "times_faster": then / now}


def result(options: argparse.Namespace) -> dict[str, Any]:
    """The JSON object."""
    scale = scale_of(options)
    found = {**asdict(scale), "threads": numba.get_num_threads(), "machine": machine()}
    found |= measure(scale, options.repeats)
    if not options.brief:
        found |= asdict(details(scale, found["kernel_ms"]["both"]))
    if options.against:
        found["against"] = {"revision": options.against, **compare(options.against, scale, options.repeats)}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_scale_options(parser)
    parser.add_argument("--against", metavar="REVISION", help="an earlier revision of this repository to compare with")
    parser.add_argument("--brief", action="store_true", help="only the kernel's time and memory")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = result(options)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for name, value in found.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        print(
            f"{name:24}", *(f"{key} {part:.4g}" if isinstance(part, float) else f"{key} {part}" for key, part in parts)
        )


if __name__ == "__main__":
    main()
