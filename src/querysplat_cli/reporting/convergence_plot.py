"""A plot of a scene's error against the time of its optimisation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.runtime.figures import new_figure, save_figure

SMOOTHED_STEPS = 7
"""The drawn line is a mean over so many steps, because each step renders other views."""


def write_curve(path: Path, runs: Sequence[dict[str, Any]]) -> None:
    """Draw loss and PSNR against seconds, run after run, from the `tto` entries of a report."""
    figure = new_figure(8.0, 3.4)
    for axes, column, name in zip(figure.subplots(1, 2), (2, 3), ("loss", "PSNR, dB"), strict=True):
        start = 0.0
        for number, run in enumerate(runs, 1):
            if not run["curve"]:
                continue
            curve = np.array(run["curve"], dtype=float)
            seconds, values = start + curve[:, 1], curve[:, column]
            (dots,) = axes.plot(seconds, values, ".", ms=3, alpha=0.3)
            label = f"{number}: {len(curve)} steps on {run['space']}"
            axes.plot(*_means(seconds, values), color=dots.get_color(), label=label)
            start = seconds[-1]
        axes.set(xlabel="seconds of optimisation", ylabel=f"{name} of each step's views")
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def _means(seconds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    span = min(SMOOTHED_STEPS, len(values))
    window = np.full(span, 1 / span)
    return np.convolve(seconds, window, "valid"), np.convolve(values, window, "valid")
