"""How well two photos alone are placed, by matcher: every set, pairs at several distances.

    python benchmarks/pairs.py [DATA] [--sets fox kermit] [--matchers sift auto] [--whole] [--weights DIR] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. A pair is reconstructed as `querysplat reconstruct`
would: both photos must be placed, else it counts as lost. Its cameras are compared with a reference: the set's own
cameras (transforms.json) where it has some, otherwise the registration of the whole set, with SIFT. Angles are in
degrees:

- RRA, the error of the relative rotation; RTA, the angle between the directions of the shift, which has a sign.
- AUC at t: the area under the curve of the share of pairs whose larger error is below a limit, for limits up to t, as a
  share of t. A lost pair has no limit.
- The focal error is |found / reference − 1|.

Seconds are those of the processor, of this program and all its threads. With --whole each set is registered as a whole
by each matcher, too: photos that are placed, and the median distance of their centres from the reference as a share of
the extent.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean, median
from typing import get_args

from common.arguments import PhotoParser
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, Use
from common.pose_errors import pose_errors
from common.samples import SEED, SIZE
from querysplat_cli.encoders.base import CameraRequest, Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.evaluation.cameras import cameras_by_name
from querysplat_cli.evaluation.poses import area_under_recall
from querysplat_cli.runtime.choices import Matcher
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.views import Photo

import numpy as np

DISTANCES = {"fox": (6, 12, 24), "kermit": (1, 2), "sceaux": (1, 2), "fortress": (1, 2), "dtu106": (1, 3)}
"""Photos from the first of a pair to the second."""
OTHER_DISTANCES = (1, 2)
MOST_PAIRS = 6
"""Pairs of one set and distance, at even distances along the set."""
LIMITS = (5.0, 15.0)


@dataclass(frozen=True)
class Row:
    """One pair: degrees, relative focal error, processor seconds. The first three are None where the pair is lost."""

    set: str
    use: Use
    apart: int
    first: str
    second: str
    matcher: str
    rotation: float | None
    translation: float | None
    focal: float | None
    seconds: float

    @property
    def worst(self) -> float:
        return np.inf if self.rotation is None or self.translation is None else max(self.rotation, self.translation)


@dataclass(frozen=True)
class Whole:
    """A whole set by one matcher; `error` is the median distance of the centres as a share of the extent."""

    set: str
    use: Use
    matcher: str
    photos: int
    placed: int
    error: float | None
    seconds: float


def cameras_of(encoder: Encoder, photos: Sequence[Photo]) -> tuple[dict[str, PhotoCamera], float]:
    """Cameras by name of the photos that are placed, and the processor's seconds."""
    start = time.process_time()
    try:
        found = cameras_by_name(encoder.estimate_cameras(photos, CameraRequest(SIZE, SEED), silent))
    except ImpossibleScene:
        found = {}
    return found, time.process_time() - start


def set_and_reference(name: str, data: Path, encoder: Encoder) -> tuple[Sequence[Photo], dict[str, PhotoCamera]]:
    """All photos of a set, and its own cameras, or where it has none those that the encoder finds."""
    files = PHOTO_SETS[name].files(data)
    photos, _ = load_photos(find_photos(files))
    known = files[0].parents[1] / "transforms.json"
    return photos, read_known_cameras(known) if known.is_file() else cameras_of(encoder, photos)[0]


def pairs_of(count: int, apart: int) -> list[tuple[int, int]]:
    """Places of both photos of at most `MOST_PAIRS` pairs among `count` photos."""
    starts = np.linspace(0, count - apart - 1, min(MOST_PAIRS, max(count - apart, 0))).round().astype(int)
    return [(int(start), int(start) + apart) for start in starts]


def rows_of(
    name: str, photos: Sequence[Photo], encoders: dict[str, Encoder], true: dict[str, PhotoCamera]
) -> Iterator[Row]:
    use = PHOTO_SETS[name].use
    for apart in DISTANCES.get(name, OTHER_DISTANCES):
        for (first, second), matcher in product(pairs_of(len(photos), apart), encoders):
            pair = photos[first], photos[second]
            names = pair[0].name, pair[1].name
            if not all(each in true for each in names):
                continue
            found, seconds = cameras_of(encoders[matcher], pair)
            errors: tuple[float | None, ...] = None, None, None
            if len(found) == 2:
                errors = pair_errors(found, {each: true[each] for each in names})
            yield Row(name, use, apart, *names, matcher, *errors, seconds)


def whole_of(
    name: str, photos: Sequence[Photo], encoders: dict[str, Encoder], true: dict[str, PhotoCamera]
) -> Iterator[Whole]:
    for matcher, encoder in encoders.items():
        found, seconds = cameras_of(encoder, photos)
        error = float(np.median(compared.centre) / compared.extent) if (compared := pose_errors(found, true)) else None
        yield Whole(name, PHOTO_SETS[name].use, matcher, len(photos), len(found), error, seconds)


def pair_errors(found: dict[str, PhotoCamera], true: dict[str, PhotoCamera]) -> tuple[float | None, ...]:
    """Degrees of rotation and shift, and the focal error; a pair that no similarity aligns counts as turned around."""
    compared = pose_errors(found, true)
    if compared is None:
        return 180.0, 180.0, None
    return tuple(abs(float(some[0])) for some in (compared.pair_rotation, compared.pair_translation, compared.focal))


def summarise(table: Table, label: str, rows: Sequence[Row]) -> None:
    """One line of the table for each matcher."""
    for matcher in dict.fromkeys(row.matcher for row in rows):
        own = [row for row in rows if row.matcher == matcher]
        placed = [row for row in own if row.rotation is not None]
        errors = np.array([row.worst for row in own])
        kinds = "rotation", "translation", "focal"
        known = [[value for row in placed if (value := getattr(row, kind)) is not None] for kind in kinds]
        middles = [median(values) if values else None for values in known]
        areas = [100 * area_under_recall(errors, limit) for limit in LIMITS]
        table.add(label, matcher, f"{len(placed)} of {len(own)}", *middles, *areas, mean(row.seconds for row in own))


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--matchers", nargs="+", choices=get_args(Matcher), default=["sift", "auto"])
    parser.add_argument("--weights", type=Path, help="folder with the weights of learned matchers")
    parser.add_argument("--whole", action="store_true", help="also register each set as a whole")
    options = parser.parse()
    encoders = {
        name: find_encoder("classical", EncoderOptions(options.weights, matcher=name)) for name in options.matchers
    }
    found: list[Row] = []
    wholes: list[Whole] = []
    columns = {"rotation, °": ".2f", "shift, °": ".2f", "focal": ".1%", "AUC 5°": ".1f", "AUC 15°": ".1f", "s": ".1f"}
    table = Table({"pairs": "", "matcher": "", "placed": "", **columns})
    for name in options.sets:
        sift = encoders.get("sift") or find_encoder("classical", EncoderOptions(matcher="sift"))
        photos, true = set_and_reference(name, options.data, sift)
        rows = list(rows_of(name, photos, encoders, true))
        for apart in dict.fromkeys(row.apart for row in rows):
            summarise(table, f"{name}, {apart} apart", [row for row in rows if row.apart == apart])
        found += rows
        if options.whole:
            some, _ = load_photos(find_photos(PHOTO_SETS[name].photos(options.data)))
            wholes += whole_of(name, some, encoders, true)
    for use in dict.fromkeys(row.use for row in found):
        summarise(table, f"**all that are {use}**", [row for row in found if row.use == use])
    if wholes:
        print()
        listing = Table({"set": "", "matcher": "", "placed": "", "centres": ".2%", "s": ".1f"})
        for each in wholes:
            listing.add(each.set, each.matcher, f"{each.placed} of {each.photos}", each.error, each.seconds)
    write_json(options.json, rows=found, whole=wholes)


if __name__ == "__main__":
    main()
