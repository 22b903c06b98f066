"""Whether one can look through scenes: over three backgrounds, and from halfway between their photos.

    querysplat reconstruct photos/ -o scene.ply --holdout-every 4 --holdout-cameras joint
    python benchmarks/solid.py scene/ [SCENE ...]

PSNR in dB is that of held-out photos (of all photos where none is held out), at the working size. Halfway is between
each input photo and the next one. *Least* is the least alpha of a pixel there, *below* the share of pixels with less
than 0.99.
"""

import argparse
from pathlib import Path

from common.output import Table
from querysplat_cli.pipeline.read_scene import read_scene, read_scene_gaussians
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.paths import halfway
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render

import torch

SOLID = 0.99
"""The alpha of a pixel that one cannot look through."""
BACKGROUNDS = {"black": 0.0, "grey": MID_GREY, "white": 1.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    scenes = parser.parse_args().scenes
    table = Table({"scene": "", **{f"{name}, dB": ".2f" for name in BACKGROUNDS}, "least": ".3f", "below": ".2%"})
    for path in scenes:
        scene, _ = read_scene(path)
        gaussians = read_scene_gaussians(path, scene)
        views, cameras = scene.heldout or (scene.views, scene.cameras)
        psnrs = [score(gaussians, views, cameras, level).psnr for level in BACKGROUNDS.values()]
        between = halfway(scene.cameras)
        with torch.no_grad():
            alphas = torch.stack([render(gaussians, between[[i]]).alpha for i in range(len(between))])
        table.add(path.stem, *psnrs, float(alphas.min()), float((alphas < SOLID).double().mean()))


if __name__ == "__main__":
    main()
