"""A drawing of a scene's numbers: opacities, sizes, and the scene from above and from the front."""

from pathlib import Path
from typing import Any

from querysplat_cli.commands.samples import drawn_points
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.gaussians import SH_0, Gaussians

MARGIN = 0.25
"""How far the drawings reach beyond the extent, in extents."""


def draw_info(path: Path, gaussians: Gaussians, found: dict[str, Any]) -> None:
    """Draw what `commands/info.py` found."""
    figure = new_figure(11.0, 8.0)
    (opacity, size), (above, front) = figure.subplots(2, 2)
    for axes, name in ((opacity, "opacity"), (size, "size")):
        edges = found[name]["edges"]
        axes.stairs(found[name]["counts"], edges, fill=True)
        axes.set(ylabel="Gaussians", yscale="log")
    opacity.set(xlabel="opacity")
    size.set(xlabel="longest axis, scene units", xscale="log")
    some = drawn_points(len(gaussians))
    x, y, z = gaussians.means[some].T.numpy()
    colours = (gaussians.sh[some, 0] * SH_0 + 0.5).clamp(0, 1).numpy()
    low, high = found["extent"]["low"], found["extent"]["high"]
    margin = MARGIN * found["extent"]["diagonal"] or 1.0
    for axes, values, row, label in ((above, z, 2, "z"), (front, -y, 1, "−y")):
        sides = (low[row], high[row]) if row == 2 else (-high[row], -low[row])
        axes.scatter(x, values, c=colours, s=1)
        axes.set(xlabel="x", ylabel=label, xlim=(low[0] - margin, high[0] + margin), aspect="equal")
        axes.set(ylim=(sides[0] - margin, sides[1] + margin))
    above.set(title="from above")
    front.set(title="from the front")
    with atomic_path(path) as draft:
        save_figure(figure, draft)
