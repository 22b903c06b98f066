"""The paper's protocol on every set that has frames enough: nine splits of fox, and those that other sets can fill.

    python benchmarks/protocol.py [DATA] -o evaluation/ [--workers N]
    python benchmarks/eval_table.py evaluation/results

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. fox has cameras of its own; those of the other sets
are found on all of their photos at once. Splits are generated, with eight cases of fox each; sets with fewer frames
take part in the splits that they can fill, in turn. Rows are the encoder's depth, 0, 20 and 50 steps, and the default
(`tto=auto`), with free and with the dataset's cameras. A run that was stopped goes on when it is repeated.
"""

import shutil
import subprocess
import sys
from pathlib import Path

from common.arguments import PhotoParser
from common.photo_sets import PHOTO_SETS
from querysplat_cli.evaluation.generate import INTERVALS, SCALES

OTHERS = ("dtu106", "kermit", "riverview", "sceaux")
"""Sets of at least eleven photos without cameras."""
CASES = {(2, "small"): 40, (2, "medium"): 16, (4, "small"): 16}
"""Cases of the splits that five, two and two sets share. The other splits are of fox alone, with eight cases."""


def querysplat(*arguments: str | Path) -> None:
    done = subprocess.run(["querysplat", *map(str, arguments)])
    if done.returncode:
        sys.exit(done.returncode)


def scene_folders(data: Path, folder: Path) -> list[Path]:
    """DL3DV's form of fox, and scene folders of the others, which hold cameras and pinhole pictures."""
    for name in OTHERS:
        ply = folder / f"{name}.ply"
        if not ply.is_file():
            feed_forward = ("--quality", "draft", "--tto", "0", "-q")
            querysplat("reconstruct", *PHOTO_SETS[name].photos(data), "-o", ply, *feed_forward)
    return [data / "dl3dv/fox", *(folder / name for name in OTHERS)]


def write_splits(scenes: list[Path], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for views in INTERVALS:
        for scale in SCALES:
            if not (folder / f"{views}views_{scale}.json").is_file():
                made = folder.parent / f"{views}views_{scale}"
                chosen = ("--views", str(views), "--scales", scale, "--cases", str(CASES.get((views, scale), 8)))
                querysplat("eval", *scenes, *chosen, "--splits-only", "-q", "-o", made)
                shutil.move(made / "splits" / f"{views}views_{scale}.json", folder)
                shutil.rmtree(made)


def main() -> None:
    parser = PhotoParser(__doc__, json=False, sets=False, passes=False)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--workers", default="2", help="as for `querysplat eval`")
    options = parser.parse()
    options.output.mkdir(parents=True, exist_ok=True)
    scenes = scene_folders(options.data, options.output)
    write_splits(scenes, options.output / "splits")
    rows = ("--cameras", "free,posed", "--sweep", "tto=0,20,50,auto", "--workers", options.workers)
    folders = ("--splits", options.output / "splits", "-o", options.output / "results")
    querysplat("eval", *scenes, *folders, *rows)


if __name__ == "__main__":
    main()
