"""What was left out of a scene or of the work, why, what that saved, and what it cost."""

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from querysplat_cli.prune.resolution import Blurred
from querysplat_cli.queries.cells import CELLS
from querysplat_cli.queries.coverage import AnchorReport
from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.formats.compressed import FARTHEST_COORDINATE, moved_to_border
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.optimise import TtoResult


@dataclass(frozen=True)
class Omission:
    """One thing that was left out.

    what, why, saved: texts for the report.
    bytes: of the .ply that it saved.
    seconds: that it saved.
    psnr_lost: dB on the input views that it cost. None of these three where it was not measured.
    """

    what: str
    why: str
    saved: str
    bytes: int | None = None
    seconds: float | None = None
    psnr_lost: float | None = None


PRUNED_GAUSSIANS, IDLE_BANDS = "Gaussians", "SH bands"
LPIPS, PRECISION, OVERLAYS, TRANSIENTS = "LPIPS loss", "precision", "overlays", "transients"
UNUSED_DEPTH = Omission("depth", "learned queries do not need it", "the depth head")


def lpips(adapted: Adapted, *, used: bool, further: bool) -> list[Omission]:
    """LPIPS, where steps were taken without it; `further`: in Gaussian space on large photos, which never use it."""
    return without_lpips(stepped=any(run.settings.steps for run, _ in adapted.runs), used=used, further=further)


def without_lpips(*, stepped: bool, used: bool, further: bool) -> list[Omission]:
    """The entry of LPIPS, by whether there were steps, whether they used it, and whether large photos followed."""
    saved = "the network's run in every step"
    if used and further:
        return [Omission(LPIPS, "it is part of the optimisation on small pictures only", saved)]
    if used or not (stepped or further):
        return []
    return [Omission(LPIPS, "its weights are not part of this package; --lpips DIR uses them", saved)]


def sfm(poses: object) -> Omission:
    return Omission("structure from motion", f"the poses are those in {poses}", "matching and mapping")


def chance_pairs(count: int) -> Omission:
    why = "they have few matches, and no third photo confirms them: photos of different places that look alike"
    return Omission("pairs of photos", why, f"{count:,} from structure from motion")


def overlays(found: MaskedShare) -> Omission:
    why = f"text, a frame, or the surroundings of a turntable stay where they are in {found.photos} photos"
    return Omission(OVERLAYS, why, f"{found.share:.1%} of the pixels")


def transients(found: MaskedShare) -> Omission:
    where = counted(found.photos, "photo")
    why = f"something stands before the scene in {where} and not in the others, such as people walking by"
    return Omission(TRANSIENTS, why, f"{found.share:.1%} of the pixels")


def resolution(finest: Blurred) -> Omission:
    return Omission(
        "resolution",
        f"the photos are blurred: pictures of {finest.size} pixels, enlarged to {finest.usual} pixels, match the "
        f"photos at that size to {finest.psnr:.0f} dB",
        f"{1 - (finest.size / finest.usual) ** 2:.0%} of the pixels",
    )


def queries(report: AnchorReport, adapted: Adapted) -> Omission:
    gone = CELLS**2 * (report.redundant + report.hiding)
    return Omission(
        "queries",
        f"of {report.blocks:,} blocks of {report.side} pixels, {report.redundant:,} show a surface that another "
        f"view shows in at least as much detail, and {report.hiding:,} would hide surfaces that other views show",
        f"{gone:,} Gaussians",
        bytes=gone * ply_bytes(adapted.gaussians.sh.shape[1]),
    )


def of_adapted(adapted: Adapted) -> list[Omission]:
    """Pruned Gaussians and SH bands."""
    found = []
    pruned, bands = adapted.pruned, adapted.gaussians.sh.shape[1]
    gone = 0 if pruned is None else int((~pruned.kept).sum())
    if pruned and gone:
        found.append(
            Omission(
                PRUNED_GAUSSIANS,
                "the Gaussians with the least influence on the renders",
                f"{gone:,} of {len(pruned.kept):,}",
                gone * ply_bytes(bands),
                _seconds(adapted.runs[0][1]),
                round(pruned.psnr_before - pruned.psnr_after, 3),
            )
        )
    idle = adapted.idle_bands
    if idle:
        found.append(
            Omission(
                IDLE_BANDS,
                "colours hardly depend on the viewing direction",
                f"{idle.count} of {bands + idle.count}",
                len(adapted.gaussians) * (ply_bytes(bands + idle.count) - ply_bytes(bands)),
                psnr_lost=round(idle.psnr_lost, 3),
            )
        )
    return found


def by_conversion(option: str, gone: int, bands: int, psnr_lost: float) -> Omission:
    """Gaussians that an option of `convert` left out; they have so many SH `bands`."""
    why = f"convert --{option}"
    return Omission(PRUNED_GAUSSIANS, why, f"{gone:,}", gone * ply_bytes(bands), psnr_lost=psnr_lost)


def of_kind(file: Path, gaussians: Gaussians, psnr_lost: float) -> list[Omission]:
    """Digits that the kind of a written file does not keep; a .ply keeps them. `gaussians` are in the file's units."""
    if file.suffix.lower() == ".ply":
        return []
    plain, size = len(gaussians) * ply_bytes(gaussians.sh.shape[1]), file.stat().st_size
    why = f"a {file.suffix} keeps fewer digits than a .ply"
    if moved := moved_to_border(file, gaussians):
        why += f", and ends at ±{FARTHEST_COORDINATE:,}: {counted(moved, 'Gaussian')} beyond that moved to there"
    return [Omission(PRECISION, why, f"{1 - size / plain:.0%} of the bytes", plain - size, psnr_lost=psnr_lost)]


def taken_further(
    before: list[dict[str, Any]], adapted: Adapted, *, bands_stay: bool, with_lpips: bool
) -> list[dict[str, Any]]:
    """The omissions of a scene that was optimised further: pruned Gaussians stay removed.

    Bands were chosen again unless `bands_stay`. LPIPS is left out where the last optimisation was without it.
    """
    again = [*lpips(adapted, used=with_lpips, further=False), *of_adapted(adapted)]
    gone = {
        *([] if bands_stay else [IDLE_BANDS]),
        *([LPIPS] if with_lpips or any(line.what == LPIPS for line in again) else []),
    }
    return [*(line for line in before if line["what"] not in gone), *map(asdict, again)]


def ply_bytes(bands: int) -> int:
    """Bytes of one Gaussian in a .ply: centre, normal, opacity, scales, rotation and three colours' SH, in float32."""
    return 4 * (3 + 3 + 1 + 3 + 4 + 3 * bands)


def _seconds(result: TtoResult) -> float | None:
    """Seconds that fewer Gaussians saved in the steps after pruning, less what pruning took."""
    whole = result.history[0].gaussians if result.history else 0
    steps = [(one.gaussians, two.gaussians, two.seconds - one.seconds) for one, two in pairwise(result.history)]
    before = [seconds for here, there, seconds in steps if here == there == whole]
    after = [seconds for here, there, seconds in steps if here == there < whole]
    change = [seconds for here, there, seconds in steps if here != there]
    if not (before and after and change):
        return None
    return round(median(before) * (len(after) + 1) - sum(after) - change[0], 2)
