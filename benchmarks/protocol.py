"""The paper's protocol on every set that has frames enough: nine splits of fox, and those that other sets can fill.

    python benchmarks/protocol.py [DATA] -o evaluation/ [--sets SET ...] [--views 2,4,12] [--cameras free,posed]
        [--workers N]
    python benchmarks/eval_table.py evaluation/results

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. fox has cameras of its own; those of the other sets
are found on all of their photos at once, or on the frames that are chosen of a film. Splits are generated, with eight
cases of each set that can fill them. Rows are the encoder's depth, 0, 20 and 50 steps, and the default (`tto=auto`),
with free and with the dataset's cameras. A run that was stopped goes on when it is repeated.
"""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from common.arguments import PhotoParser
from common.photo_sets import PHOTO_SETS
from querysplat_cli.evaluation.generate import SCALES, scenes_for
from querysplat_cli.scene.formats.dataset import find_scenes

FILMS = {"kitchen": "video/kitchen.mp4"}
SETS = ("fox", "dtu106", "kermit", "riverview", "sceaux", "highres/banana", "highres/brighton", *FILMS)
"""Those of at least eleven photos. `highres/sceaux` has the photos of `sceaux`."""
CASES = 8
"""Of each set, in each split that it can fill."""


def querysplat(*arguments: str | Path) -> None:
    done = subprocess.run([sys.executable, "-m", "querysplat_cli", *map(str, arguments)])
    if done.returncode:
        sys.exit(done.returncode)


def scene_folders(names: Sequence[str], data: Path, folder: Path) -> list[Path]:
    """DL3DV's form of fox, and scene folders of the others, which hold cameras and pinhole pictures."""
    found = []
    for name in names:
        place = folder / Path(name).name
        found.append(data / "dl3dv/fox" if name == "fox" else place)
        if name != "fox" and not place.with_suffix(".ply").is_file():
            photos = [data / FILMS[name]] if name in FILMS else PHOTO_SETS[name].photos(data)
            querysplat("reconstruct", *photos, "-o", f"{place}.ply", "--quality", "draft", "--tto", "0", "-q")
    return found


def write_splits(places: Sequence[Path], views: Sequence[int], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    scenes = find_scenes(places)
    for number in views:
        for scale in SCALES:
            file = f"{number}views_{scale}.json"
            cases = CASES * len(scenes_for(scenes, number, scale))
            if cases and not (folder / file).is_file():
                made = folder.parent / Path(file).stem
                chosen = ("--views", str(number), "--scales", scale, "--cases", str(cases))
                querysplat("eval", *places, *chosen, "--splits-only", "-q", "-o", made)
                shutil.move(made / "splits" / file, folder)
                shutil.rmtree(made)


def main() -> None:
    parser = PhotoParser(__doc__, json=False, sets=False, passes=False)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS, metavar="SET")
    parser.add_argument("--views", default="2,4,12", help="as for `querysplat eval`")
    parser.add_argument("--cameras", default="free,posed", help="as for `querysplat eval`")
    parser.add_argument("--workers", default="2", help="as for `querysplat eval`")
    options = parser.parse()
    options.output.mkdir(parents=True, exist_ok=True)
    begun = options.output / "sets.txt"
    if begun.is_file() and begun.read_text().split() != list(options.sets):
        parser.error(f"{options.output} has the splits of {begun.read_text()}: give these sets, or another output")
    begun.write_text(" ".join(options.sets))
    places = scene_folders(options.sets, options.data, options.output)
    write_splits(places, [int(number) for number in options.views.split(",")], options.output / "splits")
    rows = ("--cameras", options.cameras, "--sweep", "tto=0,20,50,auto", "--workers", options.workers)
    folders = ("--splits", options.output / "splits", "-o", options.output / "results")
    querysplat("eval", *places, *folders, *rows)


if __name__ == "__main__":
    main()
