"""Time, memory and error of the CPU splatter on random Gaussians, beside the torch reference.

    python benchmarks/splat.py [--gaussians N] [--size S] [--radius PX] [--views V] [--degree D]
                               [--against REVISION] [--brief] [--json]

The Gaussians fill the picture, with 3 standard deviations of about `radius` pixels and opacities of 0.05 to
0.95. "Forward" is everything from Gaussians to picture, "backward" everything from the picture's gradient to
the Gaussians'. Milliseconds are medians; `best` are the fastest runs, to be believed on a busy machine. The
reference runs on a smaller piece of the same density (stated), and is what the error is measured against.
`--against` times the kernel of an earlier revision, turn by turn with this one, in processes of their own.

The floor is the least time in which this machine could do the operations of the (pixel, Gaussian) pairs that
count, those of α ≥ 1/255, at the rate of fused multiply-adds that it is seen to reach.
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from querysplat_cli.reporting.report import machine
from querysplat_cli.runtime.device import peak_gib
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import RenderSettings, render

ROOT = Path(__file__).resolve().parents[1]
TURNS = 5
"""Runs of either revision in a comparison."""
OPERATIONS = {"forward": 26, "backward": 43}
"""Vector instructions for one pixel and Gaussian, counted in `compiled_blending.py`: α takes 15 (2 multiply-adds,
2 bounds, 6 for the polynomial, 3 squarings, 2 for the cut-off), light and stop 7 forward and 8 backward, the four
sums 4; backward the slope of the value 5, what lies behind 1, the slope of σ 7 and the seven sums 7."""
PIECE = 64
"""Side of the piece that the reference renders, in pixels."""
FIRST_CALL = """
import time
start = time.perf_counter()
import benchmarks_splat as b
imported = time.perf_counter()
b.both(*b.random_scene(100, 32, 4.0, 1, 1), "cpu")
print(time.perf_counter() - imported)
"""


@dataclass(frozen=True)
class Timing:
    """Milliseconds for one picture set."""

    forward: float
    backward: float
    both: float
    best_forward: float
    best_backward: float


@dataclass(frozen=True)
class Error:
    """Against the float64 reference: largest and mean of the colour's, relative L2 of each gradient's."""

    colour_max: float
    colour_mean: float
    gradients: dict[str, float]


@dataclass(frozen=True)
class Result:
    gaussians: int
    size: int
    views: int
    radius: float
    degree: int
    threads: int
    machine: str
    kernel_ms: Timing
    peak_mb: float
    """Beyond what the process took before it rendered."""


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


def random_scene(count: int, size: int, radius: float, views: int, degree: int) -> tuple[Gaussians, Cameras]:
    """Gaussians that fill `views` pictures of `size`² pixels, taken from about the same place."""
    generator = torch.Generator().manual_seed(0)
    focal = float(size)
    z = 2 + 4 * torch.rand(count, generator=generator)
    xy = (torch.rand(count, 2, generator=generator) - 0.5) * z[:, None]
    spread = torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    gaussians = Gaussians(
        torch.cat([xy, z[:, None]], 1),
        torch.randn(count, 4, generator=generator),
        spread * (radius / 3 / focal) * z[:, None],
        0.05 + 0.9 * torch.rand(count, generator=generator),
        0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
    )
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    w2c = torch.eye(4).repeat(views, 1, 1)
    w2c[:, 0, 3] = 0.02 * torch.arange(views)
    return gaussians, Cameras(w2c, K.repeat(views, 1, 1), size, size)


def both(
    gaussians: Gaussians, cameras: Cameras, backend: str, settings: RenderSettings | None = None
) -> tuple[float, float, torch.Tensor, tuple[torch.Tensor, ...]]:
    """Seconds forward and backward, the colour, and the gradients of a random linear functional of it."""
    leaves = gaussians.map(lambda field: field.detach().clone().requires_grad_())
    generator = torch.Generator().manual_seed(1)
    slope = torch.randn(len(cameras), 3, cameras.height, cameras.width, generator=generator).to(leaves.means)
    start = time.perf_counter()
    colour = render(leaves, cameras, backend=backend, settings=settings).colour
    middle = time.perf_counter()
    inputs = (leaves.means, leaves.quats, leaves.scales, leaves.opacities, leaves.sh)
    gradients = torch.autograd.grad(colour, inputs, slope)
    return middle - start, time.perf_counter() - middle, colour.detach(), gradients


def timing(
    gaussians: Gaussians, cameras: Cameras, backend: str, repeats: int, settings: RenderSettings | None = None
) -> Timing:
    runs = [both(gaussians, cameras, backend, settings)[:2] for _ in range(repeats + 1)][1:]
    forward, backward = [1e3 * run[0] for run in runs], [1e3 * run[1] for run in runs]
    return Timing(
        statistics.median(forward),
        statistics.median(backward),
        statistics.median(map(sum, zip(forward, backward, strict=True))),
        min(forward),
        min(backward),
    )


def error(gaussians: Gaussians, cameras: Cameras) -> Error:
    _, _, colour, gradients = both(gaussians, cameras, "cpu")
    _, _, exact_colour, exact = both(gaussians.to(torch.float64), cameras, "reference")
    difference = (colour - exact_colour).abs()
    names = ("means", "quats", "scales", "opacities", "sh")
    relative = [float((a - b).norm() / b.norm()) for a, b in zip(gradients, exact, strict=True)]
    return Error(float(difference.max()), float(difference.mean()), dict(zip(names, relative, strict=True)))


def work(gaussians: Gaussians, cameras: Cameras) -> tuple[int, int]:
    """Vector lanes that the kernel runs, and (pixel, Gaussian) pairs inside α ≥ 1/255; early stops not counted."""
    leaves = gaussians.map(lambda field: field.detach().clone().requires_grad_())
    blended = render(leaves, cameras, backend="cpu").colour.grad_fn
    while blended is not None and not hasattr(blended, "views"):
        blended = blended.next_functions[0][0]
    from querysplat_cli.splat.compiled_tiles import HIGH, WIDE

    lanes = evaluations = 0
    tiles_x = -(-cameras.width // WIDE)
    for view in blended.views:  # type: ignore[union-attr]
        lengths = torch.from_numpy(view.starts).diff()
        top = torch.arange(len(lengths)).repeat_interleave(lengths) // tiles_x * HIGH
        rows = torch.from_numpy(view.rows)[torch.from_numpy(view.lists).long()]
        from_top = rows[:, 1] - top - 0.5
        first = (from_top - rows[:, 11]).ceil().clamp_min(0)
        last = ((from_top + rows[:, 11]).floor() + 1).clamp_max(HIGH)
        lanes += int((last - first).clamp_min(0).sum()) * WIDE
        a, c, opacity = (torch.from_numpy(view.rows)[:, column] for column in (2, 4, 5))
        seen = torch.from_numpy(view.rows)[:, 10] > 0
        evaluations += int((2 * math.pi * (255 * opacity).log() / (a * c))[seen].sum())
    return lanes, evaluations


def first_call(cache: str) -> float:
    """Seconds that the first picture and its gradient take in a fresh process."""
    here = os.path.dirname(os.path.abspath(__file__))
    code = (
        f"import importlib.util as u, sys; s = u.spec_from_file_location('benchmarks_splat', {here!r} + '/splat.py');"
        f"m = u.module_from_spec(s); sys.modules['benchmarks_splat'] = m; s.loader.exec_module(m)\n{FIRST_CALL}"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
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
    """Float32 fused multiply-adds that all threads together reach, lanes counted."""
    sums = np.zeros((numba.get_num_threads(), 128), np.float32)
    _multiply_add(1, sums)
    rounds, seconds = 2_000_000, []
    for _ in range(5):
        start = time.perf_counter()
        _multiply_add(rounds, sums)
        seconds.append(time.perf_counter() - start)
    return rounds * sums.size / min(seconds)


def measure(scene: tuple[Gaussians, Cameras], options: argparse.Namespace) -> Result:
    both(*random_scene(100, 32, 4.0, 1, options.degree), "cpu")
    before = peak_gib()
    kernel = timing(*scene, "cpu", options.repeats)
    return Result(
        gaussians=options.gaussians,
        size=options.size,
        views=options.views,
        radius=options.radius,
        degree=options.degree,
        threads=numba.get_num_threads(),
        machine=machine(),
        kernel_ms=kernel,
        peak_mb=1024 * (peak_gib() - before),
    )


def details(scene: tuple[Gaussians, Cameras], result: Result) -> Details:
    lanes, evaluations = work(*scene)
    side = min(PIECE, result.size)
    count = max(1, round(result.gaussians * (side / result.size) ** 2))
    piece = random_scene(count, side, result.radius, 1, result.degree)
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = first_call(cache), first_call(cache)
    rate = multiply_adds_per_second()
    floor = {name: 1e3 * evaluations * operations / rate for name, operations in OPERATIONS.items()}
    return Details(
        lanes=lanes,
        evaluations=evaluations,
        evaluations_per_second=evaluations / (1e-3 * result.kernel_ms.both),
        multiply_adds_per_second=rate,
        floor_ms=floor,
        times_the_floor=result.kernel_ms.both / sum(floor.values()),
        first_call_s=cold,
        cached_first_call_s=warm,
        piece={"gaussians": count, "size": side},
        piece_kernel_ms=timing(*piece, "cpu", 15),
        piece_reference_ms=timing(*piece, "reference", 2),
        piece_error=error(*piece),
    )


def in_tree(tree: Path, options: list[str]) -> dict[str, Any]:
    """The brief result of this program with the package of another source tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src")}
    command = [sys.executable, __file__, *options, "--brief", "--json"]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout))


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A folder with the sources of `revision`."""
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", revision, "src"], cwd=ROOT, check=True, capture_output=True)
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        yield Path(folder)


def compare(revision: str, options: list[str]) -> dict[str, float]:
    """Median milliseconds of both passes here and at `revision`, and the ratio of the two."""
    with checked_out(revision) as tree:
        in_tree(tree, options)  # compiles
        turns = [(in_tree(ROOT, options), in_tree(tree, options)) for _ in range(TURNS)]
    now, then = (statistics.median(turn[i]["kernel_ms"]["both"] for turn in turns) for i in (0, 1))
    return {"now_ms": now, "then_ms": then, "times_faster": then / now}


def main() -> None:
    parser = argparse.ArgumentParser(description="Time, memory and error of the CPU splatter.")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--radius", type=float, default=8.0)
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--degree", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--against", metavar="REVISION", help="an earlier revision of this repository to compare with")
    parser.add_argument("--brief", action="store_true", help="only the kernel's time and memory")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scene = random_scene(options.gaussians, options.size, options.radius, options.views, options.degree)
    measured = measure(scene, options)
    result = asdict(measured)
    if not options.brief:
        result |= asdict(details(scene, measured))
    if options.against:
        names = ("gaussians", "size", "radius", "views", "degree", "repeats")
        chosen = [f"--{name}={getattr(options, name)}" for name in names]
        result["against"] = {"revision": options.against, **compare(options.against, chosen)}
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for name, value in result.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        print(
            f"{name:24}", *(f"{key} {part:.4g}" if isinstance(part, float) else f"{key} {part}" for key, part in parts)
        )


if __name__ == "__main__":
    main()
