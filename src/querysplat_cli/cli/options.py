"""Options that several verbs share."""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

Force = Annotated[bool, typer.Option("--force", help="Replace what is there already.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Seed = Annotated[int, typer.Option(help="The same seed on the same machine gives the same file.")]
Device = Annotated[str, typer.Option(help="auto, cpu, or cuda.")]
Queries = Annotated[str, typer.Option(metavar="N|auto", help="At most this many queries; of learned ones the first N.")]
Preset = Annotated[str, typer.Option(help="The model: a preset, or a checkpoint file.")]
Encoder = Annotated[
    str | None, typer.Option(help="The vision geometric model: classical, vggt or vggt_omega; the preset's own.")
]
Weights = Annotated[
    Path | None, typer.Option(help="The folder of downloaded weights; the Hugging Face cache by default.")
]


class NetworkPrecision(StrEnum):
    fp32 = "fp32"
    tf32 = "tf32"
    bf16 = "bf16"


Precision = Annotated[NetworkPrecision, typer.Option(help="Of the networks' matrix products.")]


class TtoSpace(StrEnum):
    features = "features"
    gaussians = "gaussians"
    both = "both"


Prune = Annotated[
    str,
    typer.Option(
        metavar="auto|off|N", help="Leave out the half of the Gaussians that is needed least (auto), or all but N."
    ),
]


RefineCameras = Annotated[
    bool | None,
    typer.Option("--refine-cameras/--no-refine-cameras", help="Correct the cameras while the scene is optimised."),
]


def amount(text: str) -> Literal["auto", "off"] | int:
    """A parser for `Prune`."""
    if text in ("auto", "off"):
        return text  # type: ignore[return-value]
    if not text.isdecimal() or int(text) < 1:
        raise typer.BadParameter(f"--prune {text!r} is neither `auto` nor `off` nor a number of Gaussians to keep")
    return int(text)


def number_or_auto(smallest: int) -> Callable[[str], int | None]:
    """A parser for `auto` (None) or a whole number of at least `smallest`."""

    def parse(text: str) -> int | None:
        if text == "auto":
            return None
        if not text.isdecimal() or int(text) < smallest:
            raise typer.BadParameter(f"{text!r} is neither `auto` nor a whole number of at least {smallest}")
        return int(text)

    return parse
