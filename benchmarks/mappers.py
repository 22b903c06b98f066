"""Cameras of many photos by COLMAP's incremental mapper, which the classical encoder takes, and by its global one.

    python benchmarks/mappers.py [DATA] [--sets SET ...] [--also FOLDER ...] [--json FILE]

Both have the same matches, and the same final bundle adjustment. All photos of a set are taken. *Placed* counts those
that have a camera. The *epipolar error* is the median distance of the matches from their epipolar lines, in thousandths
of the longer side. *Rotation* (median degrees) and *centres* (root mean square, as a share of the cameras' extent) are
errors after a similarity, where a `transforms.json` beside the photos says what is true. `--also` adds folders of
photos, as `benchmarks/street.py --keep` leaves them. Seconds are those of the processor, without features and matches.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from common.arguments import PhotoParser
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS
from common.pose_errors import pose_errors
from common.samples import SEED
from querysplat_cli.encoders.classical.epipolar import median_epipolar_error
from querysplat_cli.encoders.classical.mapping import Mapped, from_colmap, map_photos
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.views import Photo

import numpy as np
import pycolmap


@dataclass(frozen=True)
class Row:
    set: str
    use: str
    mapper: str
    photos: int
    placed: int
    epipolar_error: float | None
    rotation: float | None
    centres: float | None
    seconds: float


def mapped_globally(matches: Matches) -> Mapped | None:
    """COLMAP's global model of most photos."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = 1, SEED
    with TemporaryDirectory() as folder:
        models = pycolmap.global_mapping(matches.database, matches.folder, folder, options).values()
    largest = max(models, key=lambda model: model.num_reg_images(), default=None)
    return largest and Mapped(from_colmap(largest), matches.pairs, largest)


def rows_of(name: str, use: str, photos: list[Photo], truth: Path) -> Iterator[Row]:
    with matched(photos, seed=SEED, progress=silent) as matches:
        for mapper in ("incremental", "global"):
            start = time.process_time()
            found = map_photos(matches, photos, seed=SEED) if mapper == "incremental" else mapped_globally(matches)
            model = found and found.refined(matches)
            seconds = time.process_time() - start
            if model is None:
                yield Row(name, use, mapper, len(photos), 0, None, None, None, seconds)
                continue
            placed = {photos[number].name: camera for number, camera in model.cameras.items()}
            turned = shifted = None
            if truth.is_file():
                errors = pose_errors(placed, read_known_cameras(truth))
                turned = float(np.median(errors.rotation)) if errors else 180.0
                shifted = errors.ate / errors.extent if errors else 1.0
            error = median_epipolar_error(model, matches)
            yield Row(name, use, mapper, len(photos), len(placed), error and 1000 * error, turned, shifted, seconds)


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--also", type=Path, nargs="*", default=(), help="more folders of photos")
    options = parser.parse()
    sets = [(name, PHOTO_SETS[name].use, PHOTO_SETS[name].files(options.data)) for name in options.sets]
    sets += [(str(folder), "made up", sorted(folder.iterdir())) for folder in options.also]
    table = Table({
        "set": "", "use": "", "mapper": "", "placed": "", "epipolar error": ".2f", "rotation, °": ".2f",
        "centres": ".2%", "CPU s": ".1f",
    })  # fmt: skip
    rows: list[Row] = []
    for name, use, files in sets:
        photos, _ = load_photos(find_photos(files))
        for row in rows_of(name, use, photos, files[0].parents[1] / "transforms.json"):
            rows.append(row)
            placed = f"{row.placed} of {row.photos}"
            table.add(name, use, row.mapper, placed, row.epipolar_error, row.rotation, row.centres, row.seconds)
        write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
