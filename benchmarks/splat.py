"""Time, memory and error of the CPU splatter on random Gaussians, beside the torch reference.

    python benchmarks/splat.py [--gaussians N] [--size S] [--radius PX] [--views V] [--degree D] [--json]

The Gaussians fill the picture, with 3 standard deviations of about `radius` pixels and opacities of 0.05 to
0.95. "Forward" is everything from Gaussians to picture, "backward" everything from the picture's gradient to
the Gaussians'. Milliseconds are medians; `best` are the fastest runs, to be believed on a busy machine. The
reference runs on a smaller piece of the same density (stated), and is what the error is measured against.
"""

import argparse
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass

import numba
import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.compiled_blending import HIGH, WIDE
from querysplat_cli.splat.render import render

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
    kernel_ms: Timing
    lanes: int
    evaluations: int
    evaluations_per_second: float
    first_call_s: float
    cached_first_call_s: float
    peak_mb: float
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
    gaussians: Gaussians, cameras: Cameras, backend: str
) -> tuple[float, float, torch.Tensor, tuple[torch.Tensor, ...]]:
    """Seconds forward and backward, the colour, and the gradients of a random linear functional of it."""
    leaves = gaussians.map(lambda field: field.detach().clone().requires_grad_())
    generator = torch.Generator().manual_seed(1)
    slope = torch.randn(len(cameras), 3, cameras.height, cameras.width, generator=generator).to(leaves.means)
    start = time.perf_counter()
    colour = render(leaves, cameras, backend=backend).colour
    middle = time.perf_counter()
    inputs = (leaves.means, leaves.quats, leaves.scales, leaves.opacities, leaves.sh)
    gradients = torch.autograd.grad(colour, inputs, slope)
    return middle - start, time.perf_counter() - middle, colour.detach(), gradients


def timing(gaussians: Gaussians, cameras: Cameras, backend: str, repeats: int) -> Timing:
    runs = [both(gaussians, cameras, backend)[:2] for _ in range(repeats + 1)][1:]
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


def measure(count: int, size: int, radius: float, views: int, degree: int, repeats: int) -> Result:
    gaussians, cameras = random_scene(count, size, radius, views, degree)
    both(gaussians, cameras, "cpu")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    kernel = timing(gaussians, cameras, "cpu", repeats)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    lanes, evaluations = work(gaussians, cameras)
    side = min(PIECE, size)
    piece_count = max(1, round(count * (side / size) ** 2))
    piece = random_scene(piece_count, side, radius, 1, degree)
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = first_call(cache), first_call(cache)
    return Result(
        gaussians=count,
        size=size,
        views=views,
        radius=radius,
        degree=degree,
        threads=numba.get_num_threads(),
        kernel_ms=kernel,
        lanes=lanes,
        evaluations=evaluations,
        evaluations_per_second=evaluations / (1e-3 * kernel.both),
        first_call_s=cold,
        cached_first_call_s=warm,
        peak_mb=max(before, peak) / 1024,
        piece={"gaussians": piece_count, "size": side},
        piece_kernel_ms=timing(*piece, "cpu", repeats),
        piece_reference_ms=timing(*piece, "reference", 2),
        piece_error=error(*piece),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Time, memory and error of the CPU splatter.")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--radius", type=float, default=8.0)
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--degree", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = asdict(
        measure(options.gaussians, options.size, options.radius, options.views, options.degree, options.repeats)
    )
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for name, value in result.items():
        print(f"{name:24}", *(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in value.items())
              if isinstance(value, dict) else (f"{value:.4g}" if isinstance(value, float) else value,))  # fmt: skip


if __name__ == "__main__":
    main()
