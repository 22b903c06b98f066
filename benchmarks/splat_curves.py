"""How the CPU splatter scales, and what its settings bring: error against run time.

    python benchmarks/splat_curves.py [--write docs/splatter.md] [--json results.json] [--against REVISION]

Scaling: the random scenes of benchmarks/splat_kernel.py. Each is rendered in a process of its own, so that the memory
is that of the scene alone. Knobs: the time is that of 50,000 Gaussians at 512 × 512. The error is that of a piece of
the same density, against blending in float64 without any cut-off but the cap on α (`alpha_min` 1e-8,
`transmittance_min` 0).
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

import splat
from querysplat_cli.splat.render import RenderSettings, render
from splat_kernel import ROOT, Scale, in_tree, random_scene, timing
from splat_page import PIECE, Row, page, plot

import torch

EXACT = RenderSettings(alpha_min=1e-8, transmittance_min=0.0)
WHOLE = Scale()
GAUSSIANS = (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = (64, 128, 256, 512, 1024, 2048)
VIEWS = (1, 2, 4, 8, 16)
TILES = ((8, 8), (8, 16), (8, 32), (8, 64), (16, 8), (16, 16), (16, 32), (16, 64))
TILE_LINE = "WIDE, HIGH = 8, 32"
LIMITS = {
    "alpha_min": (1 / 32, 1 / 64, 1 / 128, 1 / 255, 1 / 400),
    "transmittance_min": (0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5),
}


def kernel(scale: Scale, repeats: int = 15, tree: Path = ROOT) -> Row:
    """Milliseconds and megabytes of one scene, in a process of its own."""
    row = in_tree(tree, scale, repeats)
    return {"ms": row["kernel_ms"]["both"], "mb": max(row["peak_mb"], 0.1)}


def scaling() -> dict[str, list[Row]]:
    """The three series of scenes."""
    counts = [{"x": n, **kernel(Scale(gaussians=n), repeats=3 if n > 200_000 else 9)} for n in GAUSSIANS]
    sizes = [{"x": side, **kernel(Scale(size=side), repeats=5)} for side in SIZES]
    views = [{"x": n, **kernel(Scale(gaussians=20_000, size=256, views=n), repeats=5)} for n in VIEWS]
    return {
        "Gaussians (512 × 512)": counts,
        "pixels a side (50,000 Gaussians)": sizes,
        "views (20,000 Gaussians, 256 × 256)": views,
    }


@contextmanager
def with_tile(wide: int, high: int) -> Iterator[Path]:
    """A copy of the sources with another tile."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        shutil.copytree(ROOT / "src", tree / "src", ignore=shutil.ignore_patterns("__pycache__"))
        file = tree / "src" / "querysplat_cli" / "splat" / "compiled_tiles.py"
        text = file.read_text()
        assert TILE_LINE in text
        file.write_text(text.replace(TILE_LINE, f"WIDE, HIGH = {wide}, {high}"))
        yield tree


def knobs() -> dict[str, list[Row]]:
    """Error and time for each value of each knob."""
    piece, whole = random_scene(PIECE), random_scene(WHOLE)
    exact = render(piece[0].to(torch.float64), piece[1], backend="reference", settings=EXACT).colour

    def row(value: str, default: bool, ms: float, colour: torch.Tensor) -> Row:
        difference = (colour.double() - exact).abs()
        error = {"max": float(difference.max()), "mean": float(difference.mean())}
        return {"value": value, "default": default, "ms": ms, **error}

    result: dict[str, list[Row]] = {}
    for name, values in LIMITS.items():
        result[name] = []
        for value in values:
            settings = replace(RenderSettings(), **{name: value})
            ms = timing(*whole, "cpu", 9, settings).both
            text = f"1/{round(1 / value)}" if name == "alpha_min" else f"{value:g}"
            default = value == getattr(RenderSettings(), name)
            result[name].append(row(text, default, ms, render(*piece, settings=settings).colour))
    colour = render(*piece).colour
    result["tile, pixels"] = [
        row(f"{wide} × {high}", f"WIDE, HIGH = {wide}, {high}" == TILE_LINE, ms, colour)
        for (wide, high), ms in _tile_times().items()
    ]
    result["precision, on the piece"] = [row("kernel, float32", True, timing(*piece, "cpu", 9).both, colour)]
    for dtype in (torch.float32, torch.float64):
        scene = piece[0].to(dtype), piece[1]
        ms = timing(*scene, "reference", 1).both
        plain = render(*scene, backend="reference").colour
        result["precision, on the piece"].append(row(f"plain torch, {str(dtype)[6:]}", False, ms, plain))
    return result


def _tile_times() -> dict[tuple[int, int], float]:
    """Milliseconds of the whole scene with each of the tiles."""
    times = {}
    for wide, high in TILES:
        with with_tile(wide, high) as tree:
            kernel(WHOLE, repeats=1, tree=tree)  # compiles
            times[wide, high] = kernel(WHOLE, tree=tree)["ms"]
    return times


def standing(count: int, size: int, against: str | None) -> Row:
    """The JSON object of splat.py."""
    command = [sys.executable, splat.__file__, f"--gaussians={count}", f"--size={size}", "--json"]
    command += ["--against", against] if against else []
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here, and its figure into images/ beside it")
    parser.add_argument("--against", metavar="REVISION", help="an earlier revision to compare with")
    parser.add_argument("--json", type=Path, help="write the results here")
    options = parser.parse_args()
    standing_rows = [standing(50_000, 512, options.against), standing(10_000, 256, None)]
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
