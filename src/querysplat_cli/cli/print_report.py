"""The report of a scene, as `reconstruct`, `tto` and `demo` print it: five lines, and the rest in report.json."""

from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import Any

from querysplat_cli.cli.terminal import print_json, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.cli.words import decibels, left_out
from querysplat_cli.reporting.omissions import OVERLAYS, PRECISION, TRANSIENTS
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime import current_folder, signals
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.words import counted

LONGEST_STAGES = 3
"""How many stages are named beside the whole time."""
FURTHER = {None: "", "standard": " --quality high", "high": " --quality max"}
"""Options of `tto`, by the level that a scene has on large photos. Steps on small pictures would take their detail."""


def print_report(report: Report, printing: Printing) -> None:
    """The report as JSON for programs; for people what was made, how good, how long it took, where, and what next."""
    print_json(report.as_dict(), printing)
    for line in lines(report):
        say(line, printing)


def exit_if_interrupted(report: Report) -> None:
    """Exit with the code of the signal that ended an optimisation early, although the scene was written."""
    if report.interrupted:
        raise QuerySplatError("stopped early", "The scene has what the optimisation had reached.", signals.exit_code())


def lines(report: Report) -> Iterator[str]:
    """Five lines, and more for photos that were left out, what a network matched, warnings and steps not kept."""
    yield f"{report.gaussians:,} Gaussians from {counted(len(report.views['used']), 'photo')}"
    yield from left_out(report.views["left_out"])
    hidden = (entry for entry in report.left_out if entry["what"] in (OVERLAYS, TRANSIENTS))
    yield from (f"left out: {entry['saved']}, where {entry['why']}" for entry in hidden)
    if report.matching and not report.quality.get("before"):
        yield _matching(report.matching)
    if report.depth_maps and not report.quality.get("before"):
        yield _depth_maps(report.depth_maps)
    yield from report.resumed
    if report.regions:
        yield _regions(report.regions, report.seams)
    yield from (f"warning: {warning}" for warning in report.warnings)
    if report.scale:
        yield _scale(report.scale)
    if sizes := (report.full_size or {}).get("not_kept"):
        shown = ", ".join(f"{size:,}" for size in sizes)
        yield f"optimisation on photos of {shown} px made them look worse, and was not kept"
    if report.tto and _in_vain(report.tto[-1]):
        yield "the last steps of optimisation did not lower the loss on the photos, and were not kept"
    yield "; ".join(_quality(report))
    yield _time(report)
    preview = Path(report.scene) / "preview.png"
    yield f"{_file(report)}; {preview} shows photos beside renders, report.json has the rest"
    yield _next(report)


def _in_vain(run: dict[str, Any]) -> bool:
    """Whether steps were taken on the small pictures, and their result is not in the scene."""
    return bool(run.get("curve")) and "max_size" not in run and run["loss_after"] >= run["loss_before"]


def _regions(regions: list[dict[str, Any]], seams: list[dict[str, Any]]) -> str:
    photos = ", ".join(str(region["photos"]) for region in regions)
    worst = min((seam["psnr"] for seam in seams), default=None)
    alike = "" if worst is None else f"; where they meet they agree to {worst:.1f} dB or better"
    return f"{len(regions)} regions of {photos} photos{alike}"


def _scale(scale: dict[str, Any]) -> str:
    off = "" if scale["residual_m"] is None else f", off by {scale['residual_m']:.3g} m in the median"
    what = {"gps": "photos", "depth": "depth maps"}.get(scale["source"], "distances")
    return f"lengths are in metres, by {scale['source']} ({scale['count']} {what}{off})"


def _matching(matching: dict[str, Any]) -> str:
    pairs = counted(matching["pairs"], "pair")
    if not matching["matcher"]:
        return f"SIFT finds few matches in {pairs} of photos; a network may find more: `querysplat weights` says how"
    before, after = matching["matches"]
    found = (
        f"{pairs} matched again by {matching['matcher']} in {matching['seconds']:.1f} s: {before:,} → {after:,} matches"
    )
    return found if matching["kept"] else f"{found}, which did not improve the cameras"


def _depth_maps(maps: dict[str, Any]) -> str:
    off = maps["difference"]
    beside = "" if off is None else f"; they differ by {off:.1%} from the depth that photos confirm"
    return f"{maps['used']} of {counted(maps['given'], 'depth map')} used{beside}"


def _quality(report: Report) -> Iterator[str]:
    """PSNR and SSIM of the renders, and how they changed where the scene was there before."""
    quality = report.quality
    large, before = quality.get("full_size"), quality.get("before") or {}
    for group, where in (("input", "the photos"), ("heldout", "held-out photos")):
        found = quality.get(group)
        if found:
            was = f"{before[group]:.2f} → " if before.get(group) is not None else ""
            yield f"{_scores(report, found, was)} on {where}"
        if large and large.get(group):
            yield f"{_scores(report, large[group])} on {where} at {large['max_size']} px"


def _scores(report: Report, found: dict[str, Any], was: str = "") -> str:
    """PSNR and SSIM, and the PSNR without exposures where the photos' differ so much that the plain one says little."""
    differ = (report.exposure or {}).get("corrected") and "psnr_cc" in found
    corrected = f" ({found['psnr_cc']:.2f} colour-corrected)" if differ else ""
    return f"PSNR {was}{found['psnr']:.2f} dB{corrected}, SSIM {found['ssim']:.3f}"


def _file(report: Report) -> str:
    """The file, its size, and what its kind loses where that is measured."""
    if report.bytes is None:
        return report.ply
    lost = [f", {decibels(entry['psnr_lost'])} by it" for entry in report.left_out if entry["what"] == PRECISION]
    return f"{report.ply} ({report.bytes / 2**20:.2f} MiB{''.join(lost)})"


def _next(report: Report) -> str:
    """What to do now. A scene in whose folder the shell stands has a new folder under the same name."""
    quality = report.quality
    before, after = (quality.get("before") or {}).get("input"), (quality.get("input") or {}).get("psnr")
    # What begins with a dash would be an option.
    ply, scene = (quote(f"./{path}" if path.startswith("-") else path) for path in (report.ply, report.scene))
    level = (report.full_size or {}).get("level") if quality.get("full_size") else None
    gained = not (before and after and after <= before)
    further = f", or querysplat tto {scene}{FURTHER[level]} for a better scene" if gained and level != "max" else ""
    return f"next: {'' if current_folder.is_there() else 'cd . && '}querysplat view {ply}{further}"


def _time(report: Report) -> str:
    stages = {stage: seconds for stage, seconds in report.seconds.items() if stage != "total"}
    longest = sorted(stages, key=lambda stage: -stages[stage])[:LONGEST_STAGES]
    named = ", ".join(f"{stage} {stages[stage]:.1f} s" for stage in longest)
    return f"{report.seconds['total']:.1f} s ({named}), at most {report.peak_memory_gib:.2f} GiB of memory"
