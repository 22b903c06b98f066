"""The log of a training: a line for every few steps, curves, and TensorBoard if asked for."""

import json
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from math import isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.figures import new_figure
from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.scene.files import atomic_path

CURVE_WINDOW = 25
"""Lines that the drawn curve is a mean of. Single lines vary, because each stands for other scenes."""

COLUMNS = ("step", "loss", "psnr", "lr", "seconds_per_step")
"""What every line has as a number, and someone reads."""


class Journal:
    """`log.jsonl` in the training's folder. A line stands for the steps since the one before.

    A figure that is not finite, because every sample was skipped, is null there and NaN here.
    """

    def __init__(self, folder: Path, step: int, *, tensorboard: bool) -> None:
        """Lines beyond `step`, of a training that went further before it was killed, are dropped, and damaged ones."""
        self._path = folder / "log.jsonl"
        self._write = _tensorboard(folder) if tensorboard else None
        rows = [row for row in self.rows() if row["step"] <= step] if self._path.is_file() else []
        with atomic_path(self._path) as draft:
            draft.write_text("".join(map(_line, rows)))

    def add(self, row: dict[str, Any]) -> None:
        """Append a line."""
        with self._path.open("a") as file:
            file.write(_line(row))
        if self._write:
            self._write(row)

    def rows(self) -> list[dict[str, Any]]:
        lines = self._path.read_text(errors="replace").splitlines()
        return [row for row in map(_parsed, lines) if row]

    def last(self) -> dict[str, Any] | None:
        """The last line; None where there is none yet."""
        return next(reversed(self.rows()), None)

    def draw(self) -> None:
        """`curve.png` beside the log."""
        rows = self.rows()
        if rows:
            with atomic_path(self._path.with_name("curve.png")) as draft:
                draw_curves(draft, rows)


def draw_curves(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Loss, PSNR and learning rate against steps."""
    figure = new_figure(11.0, 3.4)
    for axes, key, label in zip(
        figure.subplots(1, 3), ("loss", "psnr", "lr"), ("loss", "PSNR of targets, dB", "learning rate"), strict=True
    ):
        steps, values = figures(rows, key)
        axes.plot(steps, values, ".", ms=3, alpha=0.3 if key != "lr" else 1.0)
        if key != "lr":
            axes.plot(running_mean(steps), running_mean(values))
        axes.set(xlabel="step", ylabel=label)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110, format="png")


def figures(rows: Sequence[dict[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """The steps [n] and the values [n] of the lines where the figure of this name is a finite number."""
    steps, values = (np.array([row.get(key) for row in rows], dtype=float) for key in ("step", name))
    finite = np.isfinite(values)
    return steps[finite], values[finite]


def running_mean(values: np.ndarray) -> np.ndarray:
    """Means of `CURVE_WINDOW` values that follow one another, or of a third of all where these are few."""
    span = max(1, min(CURVE_WINDOW, len(values) // 3))
    return np.convolve(values, np.full(span, 1 / span), "valid") if len(values) else values


def known(value: Any) -> Any:
    """None for a figure that is not finite: JSON has no NaN and no infinity."""
    return None if isinstance(value, float) and not isfinite(value) else value


def _line(row: dict[str, Any]) -> str:
    return json.dumps({name: known(value) for name, value in row.items()}, allow_nan=False) + "\n"


def _parsed(line: str) -> dict[str, Any] | None:
    """None for a damaged line, such as one that a killed process did not finish."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict):
        return None
    row = {name: nan if value is None and name != "step" else value for name, value in row.items()}
    return row if all(isinstance(row.get(name), int | float) for name in COLUMNS) else None


def check_tensorboard() -> None:
    """Raises MissingPart where the package is not installed."""
    if not find_spec("tensorboard"):
        raise MissingPart("--tensorboard needs the package tensorboard", install_command("tensorboard"))


def _tensorboard(folder: Path) -> Callable[[dict[str, Any]], None]:
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder / "tensorboard"))

    def write(row: dict[str, Any]) -> None:
        for name, value in row.items():
            if isinstance(value, int | float) and name != "step":
                writer.add_scalar(name, value, row["step"])
        writer.flush()

    return write
