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
    gate = ", gated: ask for access there" if wanted.gated else ""
    rows = [
        ("needed by", found.needed_by),
        ("from", f"https://huggingface.co/{wanted.repository}{gate}"),
        ("licence", wanted.licence),
        ("holds", f"{wanted.tensors:,} tensors of {wanted.values:,} numbers, {wanted.gib:.2f} GiB in float32"),
        ("is", str(found.path) if found.path else f"not here: {found.absent}"),
        ("sha256", found.sha256 or wanted.sha256 or "not published; the tensors are checked one by one"),
        ("fault", f"[red]{found.fault}[/red]" if found.fault else ""),
    ]
    return rows_table(wanted.file, [row for row in rows if row[1]], indent=2)
