"""What each precision costs in exactness, and brings in time and memory.

    python benchmarks/precision.py --json benchmarks/results/precision.json [--views 2] [--queries 1024]

Full-size networks with random weights turn random photos into Gaussians, once in each precision, in a process of its
own. The result is compared with that of float32. Trained weights may lose more or less. With them, the test is
`querysplat reconstruct --precision bf16` beside fp32. Encoder and decoders are not in memory at once here, so peak GiB
is that of the larger of the two.
"""

import argparse
import gc
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import full_size
from common.output import machine, markdown, write_json
from querysplat_cli.runtime.device import peak_gib
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.splat.render import render

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

SIZE = 512


def outputs(precision: str, views: int, queries: int, device: torch.device) -> dict[str, Tensor]:
    """Features, cameras, Gaussians, and a picture of them."""
    exact = check_precision(precision)
    images = full_size.photos(views, SIZE, device)
    cameras = full_size.cameras(views, SIZE, device)
    seconds = []
    with torch.no_grad(), matrix_products(exact):
        encoder = full_size.vggt_omega(exact, device)
        start = time.perf_counter()
        found = encoder.predict(images, mixture=(0.25,) * 4, depth=False)
        _wait(device)
        seconds.append(time.perf_counter() - start)
        del encoder
        gc.collect()
        decoder = full_size.querysplat(exact, device)
        decoder.keep_queries(queries)
        start = time.perf_counter()
        made = decoder.decode(decoder.embed(found.features, images, cameras))
        _wait(device)
        seconds.append(time.perf_counter() - start)
        picture = render(made, cameras[[0]]).colour
    kept = {
        "features": found.features[0],
        "w2c": found.cameras.w2c,
        "centres": made.means,
        "scales": made.scales,
        "opacities": made.opacities,
        "sh": made.sh,
        "picture": picture,
        "cost": torch.tensor([*seconds, peak_gib(device)]),
    }
    return {name: tensor.float().cpu().contiguous() for name, tensor in kept.items()}


def compared(name: str, ours: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, Any]:
    """Errors against float32; centres in units of the scene's spread, the picture in PSNR (dB)."""
    spread = (exact["centres"] - exact["centres"].median(0).values).norm(dim=1).median()
    displaced = (ours["centres"] - exact["centres"]).norm(dim=1) / spread
    squared = (ours["picture"].clamp(0, 1) - exact["picture"].clamp(0, 1)).square().mean()
    encoder, decoder, peak = ours["cost"].tolist()
    return {
        "precision": name,
        "encoder_s": encoder,
        "decoder_s": decoder,
        "peak_gib": peak,
        "features": float((ours["features"] - exact["features"]).norm() / exact["features"].norm()),
        "w2c": float((ours["w2c"] - exact["w2c"]).abs().max()),
        "centres_median": float(displaced.median()),
        "scales_median": float((ours["scales"] / exact["scales"] - 1).abs().median()),
        "opacities_mean": float((ours["opacities"] - exact["opacities"]).abs().mean()),
        "sh_mean": float((ours["sh"] - exact["sh"]).abs().mean()),
        "picture_psnr": None if squared == 0 else float(-10 * squared.log10()),
    }


def table(rows: list[dict[str, Any]]) -> str:
    heads = {
        "encoder_s": "encoder, s",
        "decoder_s": "decoder, s",
        "peak_gib": "peak GiB",
        "features": "features, relative L2",
        "w2c": "cameras, max",
        "centres_median": "centres, median",
        "scales_median": "scales, median",
        "opacities_mean": "opacities, mean",
        "sh_mean": "SH, mean",
        "picture_psnr": "picture, PSNR dB",
    }
    cells = ((row["precision"], *("–" if row[name] is None else f"{row[name]:.3g}" for name in heads)) for row in rows)
    return markdown(("precision", *heads.values()), cells)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--queries", type=int, default=1024)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--one", nargs=2, metavar=("PRECISION", "FILE"), help="run one precision, and stop")
    options = parser.parse_args()
    if options.one:
        found = outputs(options.one[0], options.views, options.queries, torch.device(options.device))
        save_file(found, options.one[1])
        return
    # Only GPUs have TF32.
    ladder = ["fp32", "tf32", "bf16"] if options.device != "cpu" else ["fp32", "bf16"]
    same = ["--views", str(options.views), "--queries", str(options.queries), "--device", options.device]
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ladder:
            path = f"{folder}/{name}.safetensors"
            subprocess.run([sys.executable, __file__, *same, "--one", name, path], check=True)
            results[name] = load_file(path)
    rows = [compared(name, each, results["fp32"]) for name, each in results.items()]
    print(table(rows))
    where = torch.cuda.get_device_name() if options.device != "cpu" else machine()
    write_json(options.json, machine=where, torch=torch.__version__, rows=rows)


if __name__ == "__main__":
    main()
