"""The ablations of a training side by side: their curves in one figure, and their scores beside the paper's.

    python benchmarks/ablations.py small small-one-branch small-no-appearance small-no-early-regularisation \\
        --scores benchmarks/results/ablations.json --figure docs/images/ablations.png

The arguments are folders of `querysplat train`, the whole model first. A name that ends in `-seed-N` is another seed of
the same variant. `--scores` is what `benchmarks/feedforward.py --json` wrote about the models of those names. The
figure shows the reconstruction loss, which all variants have, and the PSNR of the targets. The table is printed.
"""

import argparse
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from common.output import markdown
from querysplat_cli.evaluation.published import tables
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.training.journal import figures, running_mean

PUBLISHED = {
    "": ("ablation-appearance", 0),
    "one-branch": ("ablation-appearance", 1),
    "no-appearance": ("ablation-appearance", 2),
    "no-early-regularisation": ("ablation-regularization", 1),
    "vggt": ("ablation-vgm-backbone", 1),
}
"""The paper's table and the number of its row, by the end of a variant's name; "" is the whole model."""
HEAD = ("variant", "seeds", "steps", "minutes", "made up", "against the whole", "real", "the paper's")


@dataclass(frozen=True)
class Run:
    """A training: its folder's name, the name of its variant, and the lines of its log."""

    name: str
    variant: str
    rows: list[dict[str, Any]]

    @property
    def minutes(self) -> float:
        """The seconds of all steps, in minutes; time between two runs is not counted."""
        before, total = 0, 0.0
        for row in self.rows:
            total += row["seconds_per_step"] * (row["step"] - before)
            before = row["step"]
        return total / 60


def read_run(folder: Path) -> Run:
    """The training in a folder; raises SystemExit without a log."""
    log = folder / "log.jsonl"
    if not log.is_file():
        raise SystemExit(f"{folder}: no log.jsonl, so no training of querysplat")
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    return Run(folder.name, re.sub(r"-seed-\d+$", "", folder.name), rows)


def draw(path: Path, runs: Sequence[Run]) -> None:
    """Reconstruction loss and PSNR against steps, a colour for each variant, as running means."""
    figure = new_figure(11.0, 4.0)
    variants = list(dict.fromkeys(run.variant for run in runs))
    for axes, key, label in zip(
        figure.subplots(1, 2), ("pictures", "psnr"), ("reconstruction loss", "PSNR of targets, dB"), strict=True
    ):
        for run in runs:
            steps, values = figures(run.rows, key)
            first = next(each for each in runs if each.variant == run.variant) is run
            axes.plot(
                running_mean(steps),
                running_mean(values),
                color=f"C{variants.index(run.variant)}",
                label=run.variant if first else None,
            )
        axes.set(xlabel="step", ylabel=label)
        axes.grid(alpha=0.3)
        axes.legend()
    save_figure(figure, path)


def scores_of(scores: Sequence[dict[str, Any]], runs: Sequence[Run], group: str) -> dict[str, tuple[float, float]]:
    """PSNR and SSIM of each scene of a group before any optimisation, as means over the runs."""
    names = {f"{run.name}.safetensors" for run in runs} | {run.name for run in runs}
    rows = [row for row in scores if row["group"] == group and row["row"] in names and not row["steps"]]
    return {
        scene: (
            mean(row["psnr"] for row in rows if row["set"] == scene),
            mean(row["ssim"] for row in rows if row["set"] == scene),
        )
        for scene in dict.fromkeys(row["set"] for row in rows)
    }


def difference(one: dict[str, tuple[float, float]], other: dict[str, tuple[float, float]]) -> str:
    """The mean difference of PSNR in dB, scene by scene, and its standard error."""
    apart = [one[scene][0] - other[scene][0] for scene in one if scene in other]
    if len(apart) < 2:
        return ""
    return f"{mean(apart):+.2f} ± {stdev(apart) / math.sqrt(len(apart)):.2f}"


def table(runs: Sequence[Run], scores: Sequence[dict[str, Any]]) -> str:
    """A row for each variant; the first one is the whole model."""
    whole, rows = runs[0].variant, []
    groups = {name: [run for run in runs if run.variant == name] for name in dict.fromkeys(r.variant for r in runs)}
    for variant, own in groups.items():
        made_up, real = (scores_of(scores, own, group) for group in ("made up", "real"))
        against = difference(made_up, scores_of(scores, groups[whole], "made up")) if variant != whole else ""
        rows.append(
            [
                variant,
                len(own),
                f"{own[0].rows[-1]['step']:,}",
                f"{mean(run.minutes for run in own):.1f}",
                shown(made_up),
                against,
                shown(real),
                " / ".join(f"{number:g}" for number in paper(variant, whole)),
            ]
        )
    return markdown(HEAD, rows)


def shown(found: dict[str, tuple[float, float]]) -> str:
    if not found:
        return ""
    return f"{mean(each[0] for each in found.values()):.2f} / {mean(each[1] for each in found.values()):.3f}"


def paper(variant: str, whole: str) -> tuple[float, ...]:
    """The paper's figures of a variant; nothing for one that it does not have."""
    name = "" if variant == whole else next((name for name in PUBLISHED if name and variant.endswith(name)), None)
    if name is None:
        return ()
    label, number = PUBLISHED[name]
    (published,) = (each for each in tables() if each["label"] == label)
    return tuple(published["rows"][number][metric] for metric in ("psnr", "ssim", "lpips"))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--scores", type=Path, help="what feedforward.py wrote")
    parser.add_argument("--figure", type=Path, default=Path("ablations.png"))
    options = parser.parse_args()
    runs = [read_run(folder) for folder in options.folders]
    draw(options.figure, runs)
    print(table(runs, json.loads(options.scores.read_text())["rows"] if options.scores else []))


if __name__ == "__main__":
    main()
