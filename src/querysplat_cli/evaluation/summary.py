"""The summary of a run's folder as Markdown, CSV and JSON, with a table for each number of views."""

import csv
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation import published
from querysplat_cli.evaluation.generate import SCALES
from querysplat_cli.evaluation.metrics import ALL_METRICS, METRICS
from querysplat_cli.evaluation.results import RowFolder, mean, row_folders
from querysplat_cli.evaluation.splits import GROUPS
from querysplat_cli.evaluation.stored_results import Failure, Metrics, RunConfig, Timing, read_checked
from querysplat_cli.evaluation.summary_page import markdown
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path, write_json

SHARED = tuple(f"{metric}_shared" for metric in METRICS)
"""Means without the targets that are `apart`, because they have no verified matches with any input."""
SUMMARY_COLUMNS = (
    "row", "split", "views", "scale", "group", *ALL_METRICS, *SHARED, "scored", "apart", "asked", "cases", "failed",
    "seconds_median", "seconds_low", "seconds_high", "gaussians_median", "peak_memory_gib",
)  # fmt: skip
SCORES = (*ALL_METRICS, *SHARED)


def summarise(out: Path) -> dict[str, Any]:
    """Read every result below `out`, write summary.json, .csv and .md there, and return the first.

    A split's figure is the mean over all scored views of all its cases; the average over splits of one number of
    views is the mean of their figures (as in the release).
    """
    found = [summarise_row(row_folder) for row_folder in row_folders(out)]
    rows = [row for entry in found for row in entry["groups"]]
    summary = {
        "rows": rows,
        "averages": averages(rows),
        "failures": [failure for entry in found for failure in entry["failures"]],
        "protocol": sorted({entry["config"]["protocol"] for entry in found}),
        "lpips": sorted({_about_lpips(entry["config"]) for entry in found}),
        "machine": sorted({entry["config"]["machine"] for entry in found}),
        "quoted": quoted(rows),
    }
    write_json(out / "summary.json", summary)
    write_table(out / "summary.csv", SUMMARY_COLUMNS, rows)
    with atomic_path(out / "summary.md") as draft:
        draft.write_text(markdown(summary))
    return summary


def summarise_row(row_folder: RowFolder) -> dict[str, Any]:
    """One row's figures on one split, group by group, and the cases that failed."""
    try:
        return _row(row_folder)
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        why = f"{row_folder.path}: damaged results: {type(error).__name__}: {error}"
        raise QuerySplatError(why, "Remove that folder and run the command again.") from error


def _row(row_folder: RowFolder) -> dict[str, Any]:
    config = read_checked(row_folder.path / "run_config.json", RunConfig)
    split = config["split"]
    scores: dict[str, dict[str, list[float]]] = {group: {metric: [] for metric in SCORES} for group in GROUPS}
    asked, apart, timings, failures, cases = dict.fromkeys(GROUPS, 0), dict.fromkeys(GROUPS, 0), [], [], 0
    for folder in sorted(entry for entry in row_folder.path.iterdir() if entry.is_dir() and entry.name[0] != "."):
        if (folder / "failure.json").is_file():
            failure = read_checked(folder / "failure.json", Failure)
            failures.append(
                {"row": row_folder.row, "split": row_folder.split, "case": folder.name, "error": failure["error"]}
            )
            for group, count in failure.get("asked", {}).items():  # results of older versions have no counts
                asked[group] += count
                apart[group] += len(failure.get("apart", {}).get(group, []))
            continue
        metrics = read_checked(folder / "metrics.json", Metrics)
        timings.append(read_checked(folder / "timing.json", Timing))
        cases += 1
        for group, views in metrics["per_view"].items():
            asked[group] += len(views) + len(metrics["missing"].get(group, {}))
            names = set(metrics.get("apart", {}).get(group, []))  # older results name none
            shared = [frame["name"] not in names for frame in metrics["frames"][group]]
            _collect(scores[group], views, shared)
            apart[group] += len(names)
    seconds = [timing["seconds"]["total"] for timing in timings if len(timing["seconds"]) > 1]
    low, middle, high = spread(seconds)
    common = {
        "row": row_folder.row,
        "split": row_folder.split,
        "views": split["num_input_views"],
        "scale": split["scale"],
        "cases": cases,
        "failed": len(failures),
        "seconds_median": middle,
        "seconds_low": low,
        "seconds_high": high,
        "gaussians_median": spread(not_none(timing["gaussians"] for timing in timings))[1],
        "peak_memory_gib": max(not_none(timing["peak_memory_gib"] for timing in timings), default=None),
    }
    groups = [
        {
            **common,
            "group": group,
            **{metric: mean(scores[group][metric]) for metric in SCORES},
            "scored": len(scores[group]["psnr"]),
            "apart": apart[group],
            "asked": asked[group],
        }
        for group in GROUPS
        if asked[group] or failures
    ]
    return {"config": config, "groups": groups, "failures": failures}


def _collect(into: dict[str, list[float]], views: Sequence[dict[str, Any]], shared: Sequence[bool]) -> None:
    """Add the scores of a group's views; results of older versions lack some. `shared` is False for views apart."""
    for view, shares in zip(views, shared, strict=True):
        for metric in ALL_METRICS:
            if view.get(metric) is not None:
                into[metric].append(view[metric])
        for metric, name in zip(METRICS, SHARED, strict=True):
            if shares and view.get(metric) is not None:
                into[name].append(view[metric])


def averages(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each row, number of views and group: the mean of the splits' figures."""
    together: dict[tuple[str, int, str], list[dict[str, Any]]] = {}
    for row in rows:
        together.setdefault((row["row"], row["views"], row["group"]), []).append(row)
    return [
        {
            "row": name,
            "views": views,
            "group": group,
            "splits": sum(part["scored"] > 0 for part in parts),
            **{metric: mean(part[metric] for part in parts) for metric in SCORES},
            **{key: sum(part[key] for part in parts) for key in ("scored", "apart", "asked", "cases", "failed")},
            "seconds_median": mean(part["seconds_median"] for part in parts),
            "gaussians_median": mean(part["gaussians_median"] for part in parts),
            "peak_memory_gib": max(not_none(part["peak_memory_gib"] for part in parts), default=None),
        }
        for (name, views, group), parts in together.items()
    ]


def quoted(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The paper's figures of the same numbers of views and scales: quoted, never measured.

    `rows` stand beside the averages, as means over the scales of the splits that were run; `splits` by split.
    """
    scales: dict[int, set[str]] = {}
    for row in rows:
        scales.setdefault(row["views"], set()).add(row["scale"])
    splits = {row["split"]: published.rows((row["scale"],), row["views"]) for row in rows if row["scale"] in SCALES}
    averages = [row for views, chosen in sorted(scales.items()) for row in published.rows(chosen, views)]
    return {**published.about(), "rows": averages, "splits": splits}


def spread(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Lower quartile, median, upper quartile."""
    if not values:
        return None, None, None
    if len(values) == 1:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def write_table(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """A CSV with a header."""
    with atomic_path(path) as draft, draft.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)


def not_none(values: Iterable[float | None]) -> list[float]:
    """The values that are not None."""
    return [float(value) for value in values if value is not None]


def _about_lpips(config: dict[str, Any]) -> str:
    about = config["lpips"]
    return f"LPIPS with {about['net']}" if "net" in about else str(about["missing"])
