"""What `querysplat tto` can be asked for. Every option is declared here, and only here."""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from querysplat_cli.pipeline.settings import REFINE_CAMERAS, SPACE_HELP, TtoLpips
from querysplat_cli.runtime.choices import ExposureCorrection, FullSizeLevel, Space
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.options import Device, MovedWeights, Option, Prune, Seed, StoredScenePath

COARSE = (
    "the last steps were on the small pictures, and took detail that the large photos had given; tto --quality brings "
    "it back"
)
"""The warning where steps on the small pictures followed those on larger photos."""


@dataclass(frozen=True)
class ResumeSettings:
    """How a stored scene is optimised further. None means that the program chooses."""

    scene: StoredScenePath
    quality: Annotated[
        FullSizeLevel | None,
        Option(
            "Optimise the Gaussians on the photos at up to 900 pixels (standard), 1600 pixels (high) or their own size "
            "(max). The photos must still be where they were.",
            default="what a scene of larger photos has, else the small pictures only",
        ),
    ] = None
    steps: Annotated[int | None, Ge(0), Option("Optimisation steps.", metavar="STEPS|auto", auto=True)] = None
    lr: Annotated[
        float | None,
        Ge(1e-8),
        Le(1e3),
        Option(
            "The learning rate.",
            metavar="RATE",
            default="0.02, or 0.005 for a space that was optimised in an earlier run",
        ),
    ] = None
    space: Annotated[
        Space | None,
        Option(SPACE_HELP, default="that of the last run"),
    ] = None
    prune: Prune = "off"
    densify: Annotated[
        int | None,
        Ge(1),
        Option(
            "In Gaussian space: split Gaussians where photos and renders differ most, until there are N.",
            metavar="N",
            default="no splitting",
        ),
    ] = None
    refine_cameras: Annotated[bool, REFINE_CAMERAS] = False
    weights: MovedWeights = None
    lpips: TtoLpips = None
    device: Device = "auto"
    seed: Seed = 42
    exposure: Annotated[
        ExposureCorrection,
        Option(
            "Go on with the colour transforms of the photos, if the scene has any. off: leave them out from now on.",
        ),
    ] = "auto"


def against_quality(settings: ResumeSettings) -> QuerySplatError | None:
    """The error where an option is asked for that --quality decides itself."""
    for option in ("steps", "lr", "densify"):
        if getattr(settings, option) is not None:
            return QuerySplatError(f"--quality plans everything that --{option} sets", f"Leave --{option} out.")
    if settings.space not in (None, "gaussians") or settings.prune != "off" or settings.refine_cameras:
        return QuerySplatError(
            "--quality works in Gaussian space, prunes nothing and keeps the cameras",
            "Leave --space, --prune and --refine-cameras out.",
        )
    if settings.lpips:
        return QuerySplatError(
            "--quality optimises without LPIPS, which large photos would need too much memory for", "Leave --lpips out."
        )
    return None
