"""What was left out because it would change nothing or could not be done, what that saved, and what it cost."""

from dataclasses import asdict, dataclass
from itertools import pairwise
from statistics import median
from typing import Any

from querysplat_cli.prune.resolution import Blurred
from querysplat_cli.queries.cells import CELLS
from querysplat_cli.queries.coverage import AnchorReport
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.optimise import TtoResult


@dataclass(frozen=True)
class Omission:
    """`bytes` of the .ply, `seconds`, and dB on the input views; None where nobody measured it."""

    what: str
    why: str
    saved: str
    bytes: int | None = None
    seconds: float | None = None
    psnr_lost: float | None = None


GAUSSIANS, BANDS = "Gaussians", "SH bands"
LPIPS = Omission("LPIPS loss", "its weights are not part of this package", "the network's run in every step")
SECOND_SCORE = Omission("the other cameras' score", "--budget has no time for a second scene", "a second scene")
DEPTH = Omission("depth", "learned queries do not need it", "the depth head")


def sfm(poses: object) -> Omission:
    return Omission("structure from motion", f"poses were given in {poses}", "matching and mapping")


def resolution(finest: Blurred) -> Omission:
    return Omission(
        "resolution",
        f"the photos are blurred: pictures of {finest.size} pixels, enlarged to {finest.usual}, agree with these to "
        f"{finest.psnr:.0f} dB",
        f"{1 - (finest.size / finest.usual) ** 2:.0%} of the pixels",
    )


def queries(report: AnchorReport, adapted: Adapted) -> Omission:
    gone = CELLS**2 * (report.redundant + report.hiding)
    return Omission(
        "queries",
        f"of {report.blocks:,} blocks of {report.side} pixels, {report.redundant:,} show what another view shows at "
        f"least as finely and {report.hiding:,} would hide surfaces seen by others",
        f"{gone:,} Gaussians",
        bytes=gone * ply_bytes(adapted.gaussians.sh.shape[1]),
    )


def of_adapted(adapted: Adapted) -> list[Omission]:
    """Gaussians that were pruned, and SH bands."""
    found = []
    pruned, bands = adapted.pruned, adapted.gaussians.sh.shape[1]
    gone = 0 if pruned is None else int((~pruned.kept).sum())
    if pruned and gone:
        found.append(
            Omission(
                GAUSSIANS,
                "those that the pictures miss least",
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
                BANDS,
                "colours hardly depend on the direction",
                f"{idle.count} of {bands + idle.count}",
                len(adapted.gaussians) * (ply_bytes(bands + idle.count) - ply_bytes(bands)),
                psnr_lost=round(idle.psnr_lost, 3),
            )
        )
    return found


def taken_further(before: list[dict[str, Any]], adapted: Adapted) -> list[dict[str, Any]]:
    """The lines of a scene that was taken up again: bands are looked at anew, Gaussians that are gone stay so."""
    return [*(line for line in before if line["what"] != BANDS), *map(asdict, of_adapted(adapted))]


def ply_bytes(bands: int) -> int:
    """Of one Gaussian in a .ply: centre, normal, opacity, scales, rotation and three colours' SH, in float32."""
    return 4 * (3 + 3 + 1 + 3 + 4 + 3 * bands)


def _seconds(result: TtoResult) -> float | None:
    """What fewer Gaussians saved in the steps after pruning, less what pruning took."""
    whole = result.history[0].gaussians if result.history else 0
    steps = [(one.gaussians, two.gaussians, two.seconds - one.seconds) for one, two in pairwise(result.history)]
    before = [seconds for here, there, seconds in steps if here == there == whole]
    after = [seconds for here, there, seconds in steps if here == there < whole]
    change = [seconds for here, there, seconds in steps if here != there]
    if not (before and after and change):
        return None
    return round(median(before) * (len(after) + 1) - sum(after) - change[0], 2)
