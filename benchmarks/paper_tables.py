"""The paper's tables as data: read from its source, written into the package, and checked against each other.

    python benchmarks/paper_tables.py                                  # do the appendix and the main table agree?
    python benchmarks/paper_tables.py paper-tables.tex --write         # write the package's file anew

The file is src/querysplat_cli/evaluation/published.json. Figures have all digits that the paper prints. The exit code
is 1 where an average of the appendix is not the main table's figure.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation import published

FILE = Path(published.__file__).with_name("published.json")
SOURCE = "QuerySplat: the paper's tables, and the README of the release (2026-09-18)"
NOTE = (
    "DL3DV-Evaluation, the authors' nine splits of 300 cases each. The source that was at hand has captions and no "
    "titles of sections: the text names Comparisons, a caption names Appendix A, and the other two say what they hold."
)
GROUPS = {"input": "input", "interp": "interp", "extrap": "extrap"}
SCORES = ("psnr", "ssim", "lpips")
EFFICIENCY = (
    *("encoder_seconds", "decoder_1024_seconds", "decoder_8192_seconds"),
    *("total_8192_seconds", "peak_8192_gib"),
)
SECTIONS = {"main": "Comparisons", "ablation": "Ablations", "appendix": "Appendix A", "inference": "Efficiency"}
RELEASE = {
    "label": "release-readme",
    "section": "README of the release",
    "caption": "Interpolation at 4 views of the released checkpoint official-8192 (SH degree 1).",
    "rows": [
        {
            "method": "QuerySplat, official-8192 (SH degree 1)",
            "pose_free": True,
            "views": 4,
            "scale": "average",
            "group": "interp",
            "psnr": 24.34,
            "ssim": None,
            "lpips": None,
        }
    ],
}


def read_tables(text: str) -> list[dict[str, Any]]:
    """Every table of the paper's LaTeX source, in its order."""
    return [_table(block) for block in re.findall(r"\\begin\{table\*?\}(.*?)\\end\{table\*?\}", text, re.DOTALL)]


def _table(block: str) -> dict[str, Any]:
    label = _found(r"\\label\{tab:(.*?)\}", block)
    body = _found(r"\\midrule(.*?)\\bottomrule", block)
    lines = [[_plain(cell) for cell in line.split("&")] for line in body.replace(r"\midrule", "").split(r"\\")]
    lines = [line for line in lines if len(line) > 1]
    kind = re.split(r"[-_]", label)[0]
    rows = {"main": _main, "appendix": _appendix, "ablation": _ablation, "inference": _efficiency}[kind](label, lines)
    caption = _plain(_found(r"\\caption\{(.*)\}", block, 0))
    return {"label": label, "section": SECTIONS[kind], "caption": caption, "rows": rows}


def _main(label: str, lines: list[list[str]]) -> list[dict[str, Any]]:
    """Three groups of three scores: interpolation with 2, 4 and 12 views, as the mean of three scales."""
    return [
        row
        for line in lines
        for views, scores in zip((2, 4, 12), _triples(line[2:]), strict=True)
        for row in _scored(line, views, "average", "interp", scores)
    ]


def _appendix(label: str, lines: list[list[str]]) -> list[dict[str, Any]]:
    """Three groups of three scores: input, interpolation and extrapolation of one number of views and one scale."""
    views, scale = re.fullmatch(r"appendix-(\d+)views-(\w+)", label).groups()  # type: ignore[union-attr]
    return [
        row
        for line in lines
        for group, scores in zip(GROUPS, _triples(line[2:]), strict=True)
        for row in _scored(line, int(views), scale, group, scores)
    ]


def _ablation(label: str, lines: list[list[str]]) -> list[dict[str, Any]]:
    """One variant a line. Their scale is not stated, and their schedule is shorter than that of the main table."""
    rows = []
    for line in lines:
        early = {"early_regularisation": line[1] == "yes"} if len(line) == 5 else {}
        scores = dict(zip(SCORES, map(float, line[-3:]), strict=True))
        rows.append({"method": _name(line[0]), **early, "views": 4, "group": "interp", **scores})
    return rows


def _efficiency(label: str, lines: list[list[str]]) -> list[dict[str, Any]]:
    return [{"views": int(line[0]), **dict(zip(EFFICIENCY, map(float, line[1:]), strict=True))} for line in lines]


def _scored(line: list[str], views: int, scale: str, group: str, scores: list[str]) -> list[dict[str, Any]]:
    """A row, or nothing where the paper has dashes."""
    if scores[0] == "--":
        return []
    place = {"method": _name(line[0]), "pose_free": line[1] == "yes", "views": views, "scale": scale, "group": group}
    return [{**place, **dict(zip(SCORES, map(float, scores), strict=True))}]


def _triples(cells: list[str]) -> list[list[str]]:
    return [cells[i : i + 3] for i in range(0, len(cells), 3)]


def _name(cell: str) -> str:
    return re.sub(r"TTO-?(\d+)", r"TTO-\1", cell.replace("Ours", "QuerySplat"))


def _plain(text: str) -> str:
    """LaTeX without its markup; a tick is "yes", a cross "no"."""
    text = re.sub(r"~?\\shortcite\{[^}]*\}", "", text)
    text = re.sub(r"\\(?:textbf|underline)\{([^{}]*)\}", r"\1", text)
    text = text.replace(r"$\checkmark$", "yes").replace(r"$\times$", "no").replace(r"$\Omega$", "Omega")
    return re.sub(r"\s+", " ", text).strip()


def _found(pattern: str, text: str, flags: int = re.DOTALL) -> str:
    return re.search(pattern, text, flags)[1]  # type: ignore[index]


def write(text: str) -> None:
    """Write the package's file, a row a line."""
    tables = [*read_tables(text), RELEASE]
    lines = ["{", f' "source": {json.dumps(SOURCE)},', f' "note": {json.dumps(NOTE)},', ' "tables": [']
    for table in tables:
        lines += ["  {", *(f'   "{key}": {json.dumps(table[key])},' for key in ("label", "section", "caption"))]
        lines += ['   "rows": [', ",\n".join(f"    {json.dumps(row)}" for row in table["rows"]), "   ]"]
        lines.append("  }" if table is tables[-1] else "  },")
    FILE.write_text("\n".join([*lines, " ]", "}"]) + "\n")


def report() -> int:
    """Print what does not add up; 1 where something does not, 0 else."""
    found = published.disagreements()
    for text in found:
        print(text)
    rows, tables = sum(len(table["rows"]) for table in published.tables()), len(published.tables())
    print(f"{rows} rows in {tables} tables; {len(found)} averages of the appendix do not add up")
    return int(bool(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tex", type=Path, nargs="?", help="the tables in the paper's source")
    parser.add_argument("--write", action="store_true", help="write the package's file")
    options = parser.parse_args()
    if options.write:
        if options.tex is None:
            parser.error("--write needs the paper's source")
        write(options.tex.read_text())
    sys.exit(report())


if __name__ == "__main__":
    main()
