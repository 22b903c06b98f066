"""How long the official model takes, and how much memory, beside the paper's efficiency table.

    python benchmarks/inference.py --json benchmarks/results/inference.json [--views 1 4 12] [--precision bf16]

Rows that the JSON file holds already are replaced where they are measured again, and kept otherwise.

Weights and photos are random, of full size (512 × 512 pixels, 17 + 1,024 tokens a view). The encoder's time is
that of one pass with its camera head; the decoder's that of both memories and both branches, from features
to Gaussians. Peak GiB: of the device's memory on a GPU, of the process on a CPU, where every row is a process
of its own. The first run of each is not counted. `--part` measures one network without the other in memory.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import full_size
from querysplat_cli.encoders.vggt_omega.model import VGGT_OMEGA_CONFIG, VggtOmega
from querysplat_cli.model.config import preset
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.memory import RUNTIME
from querysplat_cli.reporting.report import machine
from querysplat_cli.runtime.device import peak_gib
from querysplat_cli.runtime.precision import check_precision, matrix_products

VIEWS = [1, 4, 12, 48, 100, 300]
QUERIES = [1024, 8192]
PAPER_QUERIES = 8192
"""Those of the paper's totals."""
SIZE, SPECIALS, PATCH, WIDTH = 512, 17, 16, 2048
PAPER = {
    1: (0.080, 0.071, 0.621, 0.703, 9.28),
    4: (0.242, 0.085, 0.702, 0.949, 9.44),
    12: (0.931, 0.125, 0.943, 1.890, 10.06),
    48: (7.970, 0.297, 1.990, 10.017, 14.71),
    100: (30.031, 0.545, 3.499, 33.645, 22.59),
    300: (246.115, 1.501, 9.297, 255.725, 40.77),
}
"""Views → seconds of VGGT-Omega, decoder with 1,024 and with 8,192 queries, total; peak GiB. On an H200."""


def measure(
    views: int, queries: list[int], precision: str, device: torch.device, part: str, runs: int
) -> dict[str, Any]:
    """One row."""
    exact = check_precision(precision)
    row: dict[str, Any] = {"views": views, "precision": precision, "part": part}
    images = full_size.photos(views, SIZE, device)
    features = None
    with torch.no_grad(), matrix_products(exact):
        encoder = full_size.vggt_omega(exact, device) if part != "decoder" else None
        decoder = full_size.querysplat(exact, device) if part != "encoder" else None
        _forget_peak(device)
        if encoder is not None:
            mixture = (0.25,) * 4
            row["encoder"] = _seconds(lambda: encoder.predict(images, mixture=mixture, depth=False), device, runs)
            features = encoder.predict(images, mixture=mixture, depth=False).features
            # As the road does: decoding needs nothing of it.
            encoder.to("meta")
        if decoder is not None:
            tokens = SPECIALS + (SIZE // PATCH) ** 2
            shape = (views, tokens, WIDTH)
            features = features or (torch.randn(shape, generator=torch.Generator().manual_seed(1)).to(device),)
            cameras = full_size.cameras(views, SIZE, device)
            for count in sorted(queries, reverse=True):
                decoder.keep_queries(count)
                row[f"decoder_{count}"] = _seconds(
                    lambda: decoder.decode(decoder.encode(features, images, cameras)), device, runs
                )
    if encoder is not None and PAPER_QUERIES in queries and decoder is not None:
        row["total"] = row["encoder"] + row[f"decoder_{PAPER_QUERIES}"]
    row["peak_gib"] = peak_gib(device)
    return row


def _seconds(work: Callable[[], object], device: torch.device, runs: int) -> float:
    """The median of `runs`, after one that is not counted unless there is only one."""
    times = []
    for _ in range(runs + (runs > 1)):
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times[-runs:])


def _forget_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _in_a_process(arguments: list[str]) -> dict[str, Any]:
    done = subprocess.run([sys.executable, __file__, *arguments, "--row"], capture_output=True, text=True, check=True)
    row: dict[str, Any] = json.loads(done.stdout)
    return row


def _key(row: dict[str, Any]) -> tuple[object, ...]:
    return row["views"], row["precision"], row.get("part")


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: ours, and the paper's beside it."""
    columns = ["encoder", *(f"decoder_{count}" for count in QUERIES), "total", "peak_gib"]
    heads = ["encoder, s", *(f"decoder, {count:,} queries, s" for count in QUERIES), "total, s", "peak GiB"]
    lines = [f"| views | precision | in memory | {' | '.join(heads)} |", "| --- " * (len(heads) + 3) + "|"]
    for row in rows:
        paper = dict(zip(columns, PAPER.get(row["views"], ()), strict=False))
        cells = [
            f"{row[name]:.3g}" + (f" (paper {paper[name]:.3g})" if name in paper else "") if name in row else ""
            for name in columns
        ]
        lines.append(f"| {row['views']} | {row['precision']} | {row.get('error', row['part'])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def foretold() -> str:
    """Markdown: the GiB that `reconstruct` says beforehand, by views and precision, for 8,192 queries."""
    lines = [f"| views | {' | '.join(map(str, VIEWS))} |", "| --- " * (len(VIEWS) + 1) + "|"]
    for name in ("fp32", "bf16"):
        precision = check_precision(name)
        encoder = full_size.without_numbers(lambda: VggtOmega(VGGT_OMEGA_CONFIG), precision)
        decoder = full_size.without_numbers(lambda: QuerySplat(preset("official-8192")), precision)
        weights = sum(tensor.nbytes for tensor in encoder.state_dict().values()) + decoder.weight_bytes
        needed = []
        for views in VIEWS:
            encoding = weights + VGGT_OMEGA_CONFIG.working_bytes(views, SIZE, name == "bf16", mixed=True, depth=False)
            needed.append((RUNTIME + max(encoding, decoder.bytes_needed(views, SIZE, SPECIALS))) / 2**30)
        lines.append(f"| {name} | {' | '.join(f'{each:.1f}' for each in needed)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--queries", type=int, nargs="+", default=QUERIES)
    parser.add_argument("--precision", nargs="+", default=["fp32", "tf32", "bf16"])
    parser.add_argument("--part", choices=["both", "encoder", "decoder"], default="both")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--row", action="store_true", help="print one row as JSON and stop")
    parser.add_argument("--foretell", action="store_true", help="print what memory will be expected, and stop")
    options = parser.parse_args()
    if options.foretell:
        print(foretold())
        return
    device = torch.device(options.device)
    if options.row:
        row = measure(options.views[0], options.queries, options.precision[0], device, options.part, options.runs)
        print(json.dumps(row))
        return
    rows = []
    for precision in options.precision:
        for views in options.views:
            same = ["--queries", *map(str, options.queries), "--runs", str(options.runs), "--part", options.part]
            one = ["--views", str(views), "--precision", precision, "--device", options.device]
            try:
                rows.append(_in_a_process([*same, *one]))
            except subprocess.CalledProcessError as error:
                said = error.stderr.strip().splitlines()
                rows.append(
                    {
                        "views": views,
                        "precision": precision,
                        "part": options.part,
                        "error": said[-1] if said else "killed",
                    }
                )
            print(json.dumps(rows[-1]), file=sys.stderr)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else machine()
    print(table(rows))
    if options.json:
        before = json.loads(options.json.read_text())["rows"] if options.json.is_file() else []
        new = {_key(row) for row in rows}
        kept = [row for row in before if _key(row) not in new]
        found = {"machine": name, "torch": torch.__version__, "rows": kept + rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
