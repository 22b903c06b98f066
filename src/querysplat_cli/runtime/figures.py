"""Figures drawn with matplotlib, without a display."""

from pathlib import Path
from typing import TYPE_CHECKING

from querysplat_cli.runtime.errors import QuerySplatError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure, `width` × `height` inches. Matplotlib is imported when the first one is made."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def check_drawing(path: Path) -> None:
    """Raise QuerySplatError unless `path` names a kind of picture that can be drawn."""
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise QuerySplatError(f"{path}: not a kind of picture that can be drawn", "Use .png, .svg or .pdf.")


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a .png, .svg or .pdf, by the suffix of `path`. The same figure gives the same bytes in an .svg."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "querysplat"}):
        figure.savefig(path, dpi=130, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)
