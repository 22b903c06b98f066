"""Time and memory of the compiled kernel on random Gaussians, as one JSON object.

    python benchmarks/splat_kernel.py [--gaussians N] [--size S] [--radius PX] [--views V] [--degree D] [--repeats N]

The Gaussians fill the picture. Three standard deviations are about `radius` pixels, opacities 0.05 to 0.95. "Forward"
is everything from Gaussians to picture, "backward" everything from the picture's gradient to that of the Gaussians.
Milliseconds are medians; `best` are those of the fastest runs, which a busy machine disturbs least.

It imports nothing of the package but cameras, Gaussians and `render`, so that it runs with earlier revisions, too.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import RenderSettings, render

import torch

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Scale:
    """What the random scene and its pictures look like: `radius` in pixels, SH `degree`, pictures of `size`² pixels."""

    gaussians: int = 50_000
    size: int = 512
    radius: float = 8.0
    views: int = 1
    degree: int = 0


@dataclass(frozen=True)
class Timing:
    """Milliseconds for one set of pictures."""

    forward: float
    backward: float
    both: float
    best_forward: float
    best_backward: float


def random_scene(scale: Scale) -> tuple[Gaussians, Cameras]:
    """Gaussians that fill the pictures, which are taken from nearly the same place."""
    count, size, views = scale.gaussians, scale.size, scale.views
    generator = torch.Generator().manual_seed(0)
    focal = float(size)
    z = 2 + 4 * torch.rand(count, generator=generator)
    xy = (torch.rand(count, 2, generator=generator) - 0.5) * z[:, None]
    spread = torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    gaussians = Gaussians(
        torch.cat([xy, z[:, None]], 1),
        torch.randn(count, 4, generator=generator),
        spread * (scale.radius / 3 / focal) * z[:, None],
        0.05 + 0.9 * torch.rand(count, generator=generator),
        0.3 * torch.randn(count, (scale.degree + 1) ** 2, 3, generator=generator),
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
    """Of `repeats` runs, after one that is not counted."""
    runs = [both(gaussians, cameras, backend, settings)[:2] for _ in range(repeats + 1)][1:]
    forward, backward = [1e3 * run[0] for run in runs], [1e3 * run[1] for run in runs]
    return Timing(
        statistics.median(forward),
        statistics.median(backward),
        statistics.median(map(sum, zip(forward, backward, strict=True))),
        min(forward),
        min(backward),
    )


def measure(scale: Scale, repeats: int) -> dict[str, Any]:
    """Milliseconds, and the megabytes that rendering adds to what the process took before."""
    scene = random_scene(scale)
    both(*random_scene(Scale(100, 32, 4.0, 1, scale.degree)), "cpu")
    before = _peak_mb()
    kernel = timing(*scene, "cpu", repeats)
    return {"kernel_ms": asdict(kernel), "peak_mb": _peak_mb() - before}


def _peak_mb() -> float:
    """The most memory that the process has held, where the system tells (Linux)."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    return next((int(line.split()[1]) / 2**10 for line in lines if line.startswith("VmHWM")), math.nan)


def in_tree(tree: Path, scale: Scale, repeats: int) -> dict[str, Any]:
    """`measure` in a process of its own, with the package of another source tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src")}
    command = [sys.executable, __file__, f"--repeats={repeats}"]
    command += [f"--{name}={value}" for name, value in asdict(scale).items()]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout))


def add_scale_options(parser: argparse.ArgumentParser) -> None:
    for name, value in asdict(Scale()).items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    parser.add_argument("--repeats", type=int, default=15)


def scale_of(options: argparse.Namespace) -> Scale:
    return Scale(**{name: getattr(options, name) for name in asdict(Scale())})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_scale_options(parser)
    options = parser.parse_args()
    print(json.dumps(measure(scale_of(options), options.repeats)))


if __name__ == "__main__":
    main()
