"""How long the official model takes, and how much memory, beside the paper's efficiency table.

    python benchmarks/inference.py --json benchmarks/results/inference.json [--views 1 4 12] [--precision bf16]

Rows that the JSON file holds already are replaced where they are measured again, and kept otherwise.

Weights and photos are random, of full size (512 × 512 pixels, 17 + 1,024 tokens a view). The time of the encoder is
that of one pass with its camera head. The time of the decoder is that of both memories and both branches, from
features to Gaussians. Peak GiB are those of the device on a GPU, and those of the process on a CPU, where every row is
a process of its own. Seconds are the mean of five runs, as the paper's; `runs` in a row says of how many, and `--runs`
changes it. A first run is not counted. `--part` measures one network without the other in memory.
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

import full_size
from common.output import machine, markdown, read_rows, write_rows
from querysplat_cli.encoders.vggt_omega.model import VGGT_OMEGA_CONFIG, VggtOmega
from querysplat_cli.evaluation.published import tables
from querysplat_cli.model.config import preset
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.runtime.device import peak_gib
from querysplat_cli.runtime.precision import check_precision, matrix_products

import torch

VIEWS = [1, 2, 3, 4, 5, 6, 8, 12, 24, 48, 72, 100, 200, 300]
QUERIES = [1024, 8192]
PAPER_QUERIES = 8192
"""The paper's totals are for so many queries."""
SIZE, SPECIALS, PATCH, WIDTH = 512, 17, 16, 2048
PAPER = {"encoder": "encoder_seconds", "total": "total_8192_seconds", "peak_gib": "peak_8192_gib"}
PAPER |= {f"decoder_{count}": f"decoder_{count}_seconds" for count in QUERIES}
"""The paper's figures, measured on an H200, beside those of a row."""


def measure(
    views: int, queries: list[int], precision: str, device: torch.device, part: str, runs: int
) -> dict[str, Any]:
    """One row."""
    exact = check_precision(precision)
    row: dict[str, Any] = {"views": views, "precision": precision, "part": part, "runs": runs}
    images = full_size.photos(views, SIZE, device)
    features = None
    with torch.no_grad(), matrix_products(exact):
        encoder = full_size.vggt_omega(exact, device) if part != "decoder" else None
        decoder = full_size.querysplat(exact, device) if part != "encoder" else None
        _reset_peak_memory(device)
        if encoder is not None:
            mixture = (0.25,) * 4
            row["encoder"] = mean_seconds(lambda: encoder.predict(images, mixture=mixture, depth=False), device, runs)
            features = encoder.predict(images, mixture=mixture, depth=False).features
            # As `reconstruct` does: decoding needs nothing of the encoder.
            encoder.to("meta")
        if decoder is not None:
            tokens = SPECIALS + (SIZE // PATCH) ** 2
            shape = (views, tokens, WIDTH)
            features = features or (torch.randn(shape, generator=torch.Generator().manual_seed(1)).to(device),)
            cameras = full_size.cameras(views, SIZE, device)
            for count in sorted(queries, reverse=True):
                decoder.keep_queries(count)
                row[f"decoder_{count}"] = mean_seconds(
                    lambda: decoder.decode(decoder.embed(features, images, cameras)), device, runs
                )
    if encoder is not None and PAPER_QUERIES in queries and decoder is not None:
        row["total"] = row["encoder"] + row[f"decoder_{PAPER_QUERIES}"]
    row["peak_gib"] = peak_gib(device)
    return row


def mean_seconds(work: Callable[[], object], device: torch.device, runs: int) -> float:
    """The mean of `runs`, as in the paper, after one that is not counted unless there is only one."""
    times = []
    for _ in range(runs + (runs > 1)):
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return statistics.fmean(times[-runs:])


def _reset_peak_memory(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _in_a_process(arguments: list[str]) -> dict[str, Any]:
    done = subprocess.run([sys.executable, __file__, *arguments, "--row"], capture_output=True, text=True, check=True)
    row: dict[str, Any] = json.loads(done.stdout)
    return row


def measured(options: argparse.Namespace, views: int, precision: str) -> dict[str, Any]:
    """One row from a process of its own, or the reason why it failed."""
    same = ["--queries", *map(str, options.queries), "--runs", str(options.runs), "--part", options.part]
    one = ["--views", str(views), "--precision", precision, "--device", options.device]
    try:
        row = _in_a_process([*same, *one])
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines()
        why = lines[-1] if lines else "killed"
        row = {"views": views, "precision": precision, "part": options.part, "error": why}
    print(json.dumps(row), file=sys.stderr)
    return row


def _key(row: dict[str, Any]) -> tuple[object, ...]:
    return row["machine"], row["views"], row["precision"], row["part"]


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: ours, and the paper's beside it."""
    columns = ["encoder", *(f"decoder_{count}" for count in QUERIES), "total", "peak_gib"]
    heads = ["encoder, s", *(f"decoder, {count:,} queries, s" for count in QUERIES), "total, s", "peak GiB"]
    lines = []
    for row in rows:
        theirs = efficiency().get(row["views"], {})
        paper = {name: theirs[key] for name, key in PAPER.items() if key in theirs}
        cells = [
            f"{row[name]:.3g}" + (f" (paper {paper[name]:.3g})" if name in paper else "") if name in row else ""
            for name in columns
        ]
        lines.append((row["views"], row["precision"], row.get("error", row["part"]), row.get("runs", ""), *cells))
    return markdown(("views", "precision", "in memory", "runs", *heads), lines)


def efficiency() -> dict[int, dict[str, float]]:
    """Seconds and GiB of the paper's model on an H200, by the number of views."""
    (table,) = (table for table in tables() if table["label"] == "inference_efficiency")
    return {row["views"]: {key: value for key, value in row.items() if key != "views"} for row in table["rows"]}


def foretold() -> str:
    """Markdown: the GiB that `reconstruct` expects, by views and precision, for 8,192 queries."""
    lines = []
    for name in ("fp32", "bf16"):
        precision = check_precision(name)
        encoder = full_size.without_numbers(lambda: VggtOmega(VGGT_OMEGA_CONFIG), precision)
        decoder = full_size.without_numbers(lambda: QuerySplat(preset("official-8192")), precision)
        weights = sum(tensor.nbytes for tensor in encoder.state_dict().values()) + decoder.weight_bytes
        needed = []
        for views in VIEWS:
            encoding = weights + VGGT_OMEGA_CONFIG.working_bytes(views, SIZE, name == "bf16", mixed=True, depth=False)
            decoding = decoder.bytes_needed(views, SIZE, SPECIALS)
            needed.append((PIPELINE_POLICY.program_bytes + max(encoding, decoding)) / 2**30)
        lines.append((name, *(f"{each:.1f}" for each in needed)))
    return markdown(("views", *map(str, VIEWS)), lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--queries", type=int, nargs="+", default=QUERIES)
    parser.add_argument("--precision", nargs="+", default=["fp32", "tf32", "bf16"])
    parser.add_argument("--part", choices=["both", "encoder", "decoder"], default="both")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--row", action="store_true", help="print one row as JSON and stop")
    parser.add_argument("--foretell", action="store_true", help="print the memory that `reconstruct` expects, and stop")
    options = parser.parse_args()
    if options.foretell:
        print(foretold())
        return
    device = torch.device(options.device)
    if options.row:
        row = measure(options.views[0], options.queries, options.precision[0], device, options.part, options.runs)
        print(json.dumps(row))
        return
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else machine()
    where = {"machine": name, "torch": torch.__version__}
    rows = [where | measured(options, views, precision) for precision in options.precision for views in options.views]
    print(table(rows))
    if options.json:
        new = {_key(row) for row in rows}
        write_rows(options.json, [row for row in read_rows(options.json) if _key(row) not in new] + rows)


if __name__ == "__main__":
    main()
