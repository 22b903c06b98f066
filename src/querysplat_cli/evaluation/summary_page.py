"""The summary of an evaluation as a page of Markdown."""

from collections.abc import Sequence
from typing import Any

from querysplat_cli.evaluation.generate import SCALES
from querysplat_cli.evaluation.metrics import METRICS
from querysplat_cli.evaluation.splits import GROUPS

TITLES = {"input": "input views", "interp": "interpolation", "extrap": "extrapolation"}
SCORE_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
FURTHER_TEXT = """These figures are never the protocol's. *Colour-corrected*: each channel is mapped to the
photo's by a slope and an offset (as gsplat's trainer). *Right half*: after the 3 × 4 transform that fits the left half
best (as Inria's code). *Targets apart* have no verified matches with any input. *Fitted cameras*: each target's camera
was fitted to the finished scene. Cells are PSNR in dB / SSIM / LPIPS, the averages of the splits."""


def markdown(summary: dict[str, Any]) -> str:
    """The averages, the splits, what is quoted, and what failed."""
    parts = [f"Protocol: {', '.join(summary['protocol'])}. Machine: {'; '.join(summary['machine'])}.", ""]
    parts += [f"{text[0].upper()}{text[1:]}." for text in summary["lpips"]]
    parts += ["", "Each cell is PSNR in dB / SSIM / LPIPS, the mean over the views that were scored."]
    for views in sorted({row["views"] for row in summary["averages"]}):
        rows = [row for row in summary["averages"] if row["views"] == views]
        parts += ["", f"## {views} views, average of the splits", "", *_table(rows)]
        parts += _quoted_table([row for row in summary["quoted"]["rows"] if row["views"] == views])
    by_split = sorted(summary["rows"], key=lambda row: (row["views"], _rank(row["scale"]), row["split"]))
    for split in dict.fromkeys(row["split"] for row in by_split):
        rows = [row for row in by_split if row["split"] == split]
        parts += ["", f"## {split}", "", *_table(rows), *_quoted_table(summary["quoted"]["splits"].get(split, []))]
    parts += ["", f"Quoted figures: {summary['quoted']['source']}. {summary['quoted']['note']}"]
    parts += _further(summary["averages"])
    if summary["failures"]:
        parts += ["", "## Failed cases", ""]
        parts += [f"- {each['row']}, {each['split']}, {each['case']}: {each['error']}" for each in summary["failures"]]
    return "\n".join(parts) + "\n"


def cell(row: dict[str, Any], ending: str = "") -> str:
    """PSNR / SSIM / LPIPS of the keys with this ending, a dash for what there is not."""
    found = [(row[metric + ending], SCORE_DIGITS[metric]) for metric in METRICS]
    return " / ".join("–" if value is None else f"{value:.{digits}f}" for value, digits in found)


def _table(rows: Sequence[dict[str, Any]]) -> list[str]:
    by_row: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        by_row.setdefault(row["row"], {})[row["group"]] = row
    groups = [group for group in GROUPS if any(group in cells for cells in by_row.values())]
    titles = [
        "row",
        *(TITLES[group] for group in groups),
        "views scored",
        "targets apart",
        "cases failed",
        "seconds",
        "Gaussians",
        "GiB",
    ]
    lines = [f"| {' | '.join(titles)} |", f"|{' --- |' * len(titles)}"]
    for name, cells in by_row.items():
        some = next(iter(cells.values()))
        scored, asked = (sum(part[key] for part in cells.values()) for key in ("scored", "asked"))
        numbers = [
            *(cell(cells[group]) if group in cells else "–" for group in groups),
            f"{scored} of {asked}",
            str(sum(part["apart"] for part in cells.values())),
            f"{some['failed']} of {some['failed'] + some['cases']}",
            _number(some["seconds_median"], ".1f"),
            _number(some["gaussians_median"], ",.0f"),
            _number(some["peak_memory_gib"], ".2f"),
        ]
        lines.append(f"| {name} | {' | '.join(numbers)} |")
    return lines


def _quoted_table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The paper's figures, a line for each method; nothing where the paper has none."""
    if not rows:
        return []
    lines = ["", "*Quoted from the paper, not measured here:*", ""]
    lines += [f"| method | cameras | {' | '.join(TITLES.values())} | where |", f"|{' --- |' * 6}"]
    together: dict[tuple[str, bool], dict[str, dict[str, Any]]] = {}
    for row in rows:
        together.setdefault((row["method"], row["pose_free"]), {})[row["group"]] = row
    for (method, pose_free), groups in together.items():
        cells = [cell(groups[group]) if group in groups else "–" for group in GROUPS]
        where = ", ".join(dict.fromkeys(row["where"] for row in groups.values()))
        lines.append(f"| {method} | {'free' if pose_free else 'given'} | {' | '.join(cells)} | {where} |")
    return lines


def _further(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What stands beside the protocol's scores, for each row and group in which anything was measured."""
    lines = ["", "## Beside the protocol", "", FURTHER_TEXT, ""]
    titles = "row", "views", "group", "colour-corrected", "right half", "targets apart left out", "fitted cameras"
    lines += [f"| {' | '.join([*titles, 'FLIP', 'SSIMULACRA2'])} |", f"|{' --- |' * 9}"]
    for row in rows:
        triples = [cell(row, ending) for ending in ("_cc", "_half", "_shared", "_fitted")]
        numbers = [_number(row["flip"], ".3f"), _number(row["ssimulacra2"], ".1f")]
        lines.append(f"| {' | '.join([row['row'], str(row['views']), TITLES[row['group']], *triples, *numbers])} |")
    return lines


def _rank(scale: str) -> int:
    return SCALES.index(scale) if scale in SCALES else len(SCALES)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
