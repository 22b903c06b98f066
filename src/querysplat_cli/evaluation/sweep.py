"""Quality against cost of each row of a run, and the rows that no other row beats."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation.metrics import METRICS
from querysplat_cli.evaluation.results import RowFolder, row_folders
from querysplat_cli.evaluation.stored_results import Metrics, RunConfig, Timing, read_checked
from querysplat_cli.evaluation.summary import not_none, spread, write_table
from querysplat_cli.evaluation.summary_page import TITLES
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.files import atomic_path, write_json

COSTS = {"seconds": "seconds", "gaussians": "Gaussians", "peak_memory_gib": "peak memory, GiB"}
NAMES = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
FORMS = {"psnr": ".2f", "ssim": ".3f", "lpips": ".3f", "seconds": ".1f", "gaussians": ",.0f", "peak_memory_gib": ".2f"}
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")


@dataclass(frozen=True)
class Spread:
    """Lower quartile, median and upper quartile over cases; None where no case has the figure."""

    low: float | None
    middle: float | None
    high: float | None


@dataclass(frozen=True)
class Point:
    """A row on all splits of one number of views, over the cases in which it has scores of `group`.

    `best` names the metric and cost pairs in which no other row of as many views is as good for less.
    """

    row: str
    views: int
    group: str
    cases: int
    figures: dict[str, Spread]
    best: tuple[str, ...] = ()


def write_curves(out: Path) -> list[Point]:
    """Write sweep.json, .csv, .md, .png and .svg of all results below `out`, and return the points."""
    points = frontier(collect(row_folders(out), "interp"))
    flat = [_flat(point) for point in points]
    write_json(out / "sweep.json", flat)
    write_table(out / "sweep.csv", list(flat[0]) if flat else ["row"], flat)
    with atomic_path(out / "sweep.md") as draft:
        draft.write_text(markdown(points))
    draw(points, [out / "sweep.png", out / "sweep.svg"])
    return points


def collect(found: Sequence[RowFolder], group: str) -> list[Point]:
    """One point for each row and number of views."""
    together: dict[tuple[int, str], list[dict[str, float | None]]] = {}
    for row_folder in found:
        views = read_checked(row_folder.path / "run_config.json", RunConfig)["split"]["num_input_views"]
        for file in sorted(row_folder.path.glob("*/metrics.json")):
            scores = read_checked(file, Metrics)["mean"].get(group, {})
            if scores.get("psnr") is None:
                continue
            timing = read_checked(file.with_name("timing.json"), Timing)
            case = {metric: scores[metric] for metric in METRICS}
            case |= {"gaussians": timing["gaussians"], "peak_memory_gib": timing["peak_memory_gib"]}
            case["seconds"] = timing["seconds"]["total"] or None
            together.setdefault((views, row_folder.row), []).append(case)
    return [
        Point(
            row,
            views,
            group,
            len(cases),
            {key: Spread(*spread(not_none(case[key] for case in cases))) for key in (*METRICS, *COSTS)},
        )
        for (views, row), cases in sorted(together.items())
    ]


def frontier(points: Sequence[Point]) -> list[Point]:
    """The points with `best` filled in, by the medians."""
    marked = []
    for point in points:
        rivals = [other for other in points if other.views == point.views and other is not point]
        pairs = [(metric, cost) for metric in METRICS for cost in COSTS]
        best = tuple(f"{m} for {c}" for m, c in pairs if _unbeaten(point, rivals, m, c))
        marked.append(replace(point, best=best))
    return marked


def markdown(points: Sequence[Point]) -> str:
    """A table with medians and quartiles; bold where no other row is as good in as little time."""
    lines = []
    for views in sorted({point.views for point in points}):
        chosen = [point for point in points if point.views == views]
        lines += [f"## {views} views, {TITLES[chosen[0].group]}, median (quartiles) over cases", ""]
        lines += [f"| row | cases | {' | '.join([*NAMES.values(), *COSTS.values()])} |", "| --- " * 8 + "|"]
        for point in sorted(chosen, key=lambda point: point.figures["seconds"].middle or 0.0):
            cells = [_cell(point.figures[key], FORMS[key]) for key in (*METRICS, *COSTS)]
            bold = "**" if "psnr for seconds" in point.best else ""
            lines.append(f"| {bold}{point.row}{bold} | {point.cases} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join([*lines, "Bold: no other row has as high a PSNR in as few seconds.", ""])


def draw(points: Sequence[Point], files: Sequence[Path]) -> None:
    """Quality against cost, a curve of unbeaten rows for each number of views; bars are quartiles."""
    from matplotlib.lines import Line2D

    metrics = [metric for metric in METRICS if any(point.figures[metric].middle is not None for point in points)]
    figure = new_figure(4.2 * len(COSTS), 3.2 * max(1, len(metrics)))
    axes = figure.subplots(max(1, len(metrics)), len(COSTS), squeeze=False)
    for line, metric in zip(axes, metrics, strict=False):
        for axis, cost in zip(line, COSTS, strict=True):
            _curve(axis, points, metric, cost)
            axis.set_xlabel(COSTS[cost])
            axis.set_ylabel(NAMES[metric])
            axis.grid(alpha=0.3)
    if points:
        axes[0][0].legend(fontsize=7)
        rows = [f"{number}  {row}" for row, number in _numbers(points).items()]
        figure.legend([Line2D([], [])] * len(rows), rows, handlelength=0, fontsize=7, loc="outside right upper")
    for file in files:
        with atomic_path(file) as draft:
            save_figure(figure, draft)


def _curve(axes: Any, points: Sequence[Point], metric: str, cost: str) -> None:
    for views, colour in zip(sorted({point.views for point in points}), COLOURS, strict=False):
        chosen = [point for point in points if point.views == views and _has(point, metric, cost)]
        for point in chosen:
            x, y = point.figures[cost], point.figures[metric]
            whiskers = [[[s.middle - s.low], [s.high - s.middle]] for s in (x, y)]  # type: ignore[operator]
            axes.errorbar(x.middle, y.middle, *reversed(whiskers), "o", color=colour, ms=4, lw=0.8, alpha=0.8)
            number = str(_numbers(points)[point.row])
            axes.annotate(number, (x.middle, y.middle), xytext=(3, 3), textcoords="offset points", fontsize=6)
        best = [point for point in chosen if f"{metric} for {cost}" in point.best]
        best.sort(key=lambda point: point.figures[cost].middle or 0.0)
        line = [[point.figures[key].middle for point in best] for key in (cost, metric)]
        axes.plot(*line, color=colour, lw=1.2, label=f"{views} views")


def _numbers(points: Sequence[Point]) -> dict[str, int]:
    """The number of each row in the figure."""
    return {row: number for number, row in enumerate(sorted({point.row for point in points}), start=1)}


def _unbeaten(point: Point, rivals: Sequence[Point], metric: str, cost: str) -> bool:
    if not _has(point, metric, cost):
        return False
    return not any(_has(other, metric, cost) and _beats(other, point, metric, cost) for other in rivals)


def _beats(one: Point, other: Point, metric: str, cost: str) -> bool:
    sign = 1 if HIGHER_IS_BETTER[metric] else -1
    gain = sign * ((one.figures[metric].middle or 0.0) - (other.figures[metric].middle or 0.0))
    saved = (other.figures[cost].middle or 0.0) - (one.figures[cost].middle or 0.0)
    return gain >= 0 and saved >= 0 and (gain > 0 or saved > 0)


def _has(point: Point, metric: str, cost: str) -> bool:
    return point.figures[metric].middle is not None and point.figures[cost].middle is not None


def _flat(point: Point) -> dict[str, Any]:
    flat: dict[str, Any] = {"row": point.row, "views": point.views, "group": point.group, "cases": point.cases}
    for key, figure in point.figures.items():
        flat |= {f"{key}_median": figure.middle, f"{key}_low": figure.low, f"{key}_high": figure.high}
    return flat | {"best": "; ".join(point.best)}


def _cell(figure: Spread, form: str) -> str:
    if figure.middle is None or figure.low is None or figure.high is None:
        return "–"
    return f"{figure.middle:{form}} ({figure.low:{form}}–{figure.high:{form}})"
