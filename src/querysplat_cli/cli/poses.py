"""`querysplat poses`: two sets of cameras of the same photos."""

from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import PosesRequest
from querysplat_cli.runtime.colmap import load_pycolmap


def poses(request: PosesRequest, printing: Printing) -> None:
    """Compare two sets of cameras of the same photos.

    A similarity first joins them. The errors are those of rotation, centre and focal length, with RRA, RTA, AUC and
    ATE.
    """
    load_pycolmap()
    from querysplat_cli.cli.terminal import print_json, say, showing_stages
    from querysplat_cli.commands.poses import compare

    with showing_stages(printing) as stages:
        summary, second = compare(request, stages)
    print_json(summary, printing)
    say(_table(summary, str(request.first), second), printing)


def _table(summary: dict[str, Any], first: str, second: str) -> Any:
    from querysplat_cli.cli.terminal import rows_table

    rows = [("photos in both", f"{summary['photos']}")]
    for side, names in ((first, summary["only_a"]), (second, summary["only_b"])):
        if names:
            rows.append((f"only in {side}", f"{len(names)}: {', '.join(names[:3])}{', …' if names[3:] else ''}"))
    rotation, centre, focal = (summary[key] for key in ("rotation_degrees", "centre", "focal_error"))
    rows += [
        ("rotation", f"median {rotation['median']:.3f}°, worst {rotation['max']:.3f}°"),
        ("centre", f"median {centre['median']:.4g}, worst {centre['max']:.4g} units of {second}"),
        ("ATE", f"{summary['ate']:.4g}, {100 * summary['ate_of_extent']:.2f} % of the extent"),
    ]
    for name in ("rra", "rta", "auc"):
        cells = (f"{summary[f'{name}_{t}']:.1f} %" for t in (5, 15, 30))
        rows.append((f"{name.upper()} at 5, 15, 30°", ", ".join(cells)))
    rows.append(("focal length", f"median {100 * focal['median']:+.2f} %, worst {100 * focal['max_abs']:.2f} %"))
    return rows_table(f"{first} against {second}", rows)
