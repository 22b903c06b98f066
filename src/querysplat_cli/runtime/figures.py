"""Figures drawn with matplotlib, without a display."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure, `width` × `height` inches. Matplotlib is imported when the first one is made."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a .png, .svg or .pdf, by the suffix of `path`. The same figure gives the same bytes in an .svg."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "querysplat"}):
        figure.savefig(path, dpi=130, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)
