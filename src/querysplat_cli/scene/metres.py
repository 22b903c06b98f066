"""How many metres a unit of a scene is, from places or distances that are known of its photos."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.sim3 import least_squares_fit

EARTH = 6_378_137.0, 6.69437999014e-3
"""WGS 84: half of the larger axis in metres, and the squared eccentricity."""
FEWEST_PLACES = 4
"""Photos with GPS that determine a similarity and show how far off they are."""
ROUNDS = 30
"""Of reweighting."""
CLEAR = 3.0
"""In the median, places must lie this many times their error from their middle, or they say nothing about size."""


@dataclass(frozen=True)
class Metres:
    """The length of a scene's unit, and how well it is known.

    `residual` is the median distance of a photo from where it should be, or of a length from what it should be, in
    metres; None where one length gives no residual.
    """

    per_unit: float
    source: str
    count: int
    residual: float | None

    def entry(self) -> dict[str, float | int | str | None]:
        """As in the report."""
        residual = None if self.residual is None else round(self.residual, 4)
        return {"source": self.source, "count": self.count, "metres_per_unit": self.per_unit, "residual_m": residual}


def check_gps(places: int, photos: int) -> None:
    """Raise QuerySplatError where so few of so many photos have a GPS place that these say nothing."""
    if places < FEWEST_PLACES:
        raise QuerySplatError(
            f"--scale gps: {places} of the {photos} photos used state in EXIF where they were taken",
            f"At least {FEWEST_PLACES} have to. Give a distance between two photos instead: --scale a.jpg,b.jpg=1.5.",
        )


def check_names(lengths: Sequence[tuple[str, str, float]], photos: Collection[str]) -> None:
    """Raise QuerySplatError where a distance is one from another photo."""
    for one, other, _ in lengths:
        missing = [name for name in (one, other) if name not in photos]
        if missing:
            raise QuerySplatError(
                f"--scale: {missing[0]} is none of the photos used", "Give names as in `views.used` of report.json."
            )


def metres_by_gps(centres: Mapping[str, np.ndarray], places: Mapping[str, Gps]) -> Metres:
    """From a robust similarity between camera centres [3], in scene units, and the photos' GPS places.

    Residuals are weighted by 1 / (1 + (r / 2σ)²), where σ follows from their median (iteratively reweighted least
    squares). Where a photo states no height, all are taken to be equally high. Raises QuerySplatError when too few
    photos have GPS, or when they are too close together for its errors.
    """
    names = [name for name in centres if name in places]
    check_gps(len(names), len(centres))
    ours = np.stack([centres[name] for name in names])
    theirs = local_metres([places[name] for name in names])
    weights = np.ones(len(names))
    for _ in range(ROUNDS):
        scale, residuals = least_squares_fit(ours, theirs, weights)
        sigma = max(1.4826 * float(np.median(residuals)), 1e-9)
        weights = 1 / (1 + (residuals / (2 * sigma)) ** 2)
    error = float(np.median(residuals))
    spread = float(np.median(np.linalg.norm(theirs - np.median(theirs, axis=0), axis=1)))
    if not scale > 0 or spread < CLEAR * error:
        raise QuerySplatError(
            f"--scale gps: the photos lie about {spread:.1f} m around their middle, and GPS is off by {error:.1f} m",
            "Give a distance between two photos instead: --scale a.jpg,b.jpg=1.5.",
        )
    return Metres(scale, "gps", len(names), error)


def metres_by_distances(centres: Mapping[str, np.ndarray], lengths: Sequence[tuple[str, str, float]]) -> Metres:
    """From known distances in metres between the places of two photos each: the median ratio.

    Raises QuerySplatError when a photo has no camera, or two stand at one place.
    """
    check_names(lengths, centres)
    ratios = []
    for one, other, metres in lengths:
        apart = float(np.linalg.norm(centres[one] - centres[other]))
        if apart <= 1e-9:
            raise QuerySplatError(f"--scale: {one} and {other} were taken from one place", "Give two other photos.")
        ratios.append(metres / apart)
    per_unit = float(np.median(ratios))
    wrong = [abs(metres - metres * per_unit / ratio) for (*_, metres), ratio in zip(lengths, ratios, strict=True)]
    return Metres(per_unit, "distances", len(lengths), float(np.median(wrong)) if len(lengths) > 1 else None)


def local_metres(places: Sequence[Gps]) -> np.ndarray:
    """East, north and up [n, 3] in metres (WGS 84, plane at the median latitude).

    East counts from the first place, north from the median latitude, and up from sea level; up is 0 for all places
    where one of them has no height.
    """
    latitude, longitude = np.radians([[place.latitude, place.longitude] for place in places]).T
    heights = [place.height for place in places]
    known = [height for height in heights if height is not None]
    up = np.array(known) if len(known) == len(heights) else np.zeros(len(heights))
    middle = float(np.median(latitude))
    axis, squared = EARTH
    bent = 1 - squared * np.sin(middle) ** 2
    along, across = axis * (1 - squared) / bent**1.5, axis / np.sqrt(bent) * np.cos(middle)
    # Differences of longitude are taken around the first place, so that the date line is no border.
    turned = (longitude - longitude[0] + np.pi) % (2 * np.pi) - np.pi
    return np.stack([turned * across, (latitude - middle) * along, up], 1)
