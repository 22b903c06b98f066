"""What people who walk through photos cost a scene, and what leaving them out brings.

    python benchmarks/transients.py [DATA] [--sets fortress kermit] [--json results.json] [--keep DIR]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out. Made-up people of one or
two colours are drawn over about half of the others, never twice at the same place. Each row is one run of the command
with joint cameras: the photos as they are, those with people and `--transients off`, those with people as usual, and
those with people and masks of them. "Found" is the share of the people's pixels that was left out, and "beside" the
share of all other pixels of the input photos. PSNR is over grey and SSIM over black, of held-out photos, which show
nobody.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.arguments import PhotoParser, folder_or_scratch
from common.command import reconstructed
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet
from common.samples import HOLDOUT_EVERY, SEED
from querysplat_cli.scene.masks import MASKS
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.views import Photo

import cv2
import numpy as np
from safetensors.torch import load_file

SHARE = 0.5
"""Of the photos that are not held out, so many show somebody."""
TALL = (0.35, 0.6)
"""How tall people are, in heights of the photo."""


@dataclass(frozen=True)
class Run:
    """What is reconstructed: the photos of a folder, with these options."""

    label: str
    folder: str
    options: tuple[str, ...] = ()


RUNS = (
    Run("as they are", "clean"),
    Run("people, `--transients off`", "people", ("--transients", "off")),
    Run("people", "people"),
    Run("people, masked", "masked"),
)


def draw_somebody(picture: np.ndarray, shown: np.ndarray, chance: np.random.Generator) -> None:
    """Draw somebody into a picture [height, width, 3], and into `shown` [height, width], which is 255 there."""
    height, width = shown.shape
    tall = chance.uniform(*TALL) * height
    middle, foot = chance.uniform(0.1, 0.9) * width, chance.uniform(0.8, 1.0) * height
    head, hip = tall * 0.09, foot - tall * 0.45
    skin, shirt, trousers = (130, 160, 205), *(tuple(chance.uniform(20, 235, 3).tolist()) for _ in range(2))
    thick = max(int(tall * 0.07), 1)
    for each, colour in ((picture, (skin, shirt, trousers)), (shown, (255, 255, 255))):
        cv2.circle(each, (int(middle), int(foot - tall + head)), int(head), colour[0], -1, cv2.LINE_AA)
        corners = (int(middle - tall * 0.13), int(foot - tall * 0.81)), (int(middle + tall * 0.13), int(hip))
        cv2.rectangle(each, *corners, colour[1], -1)
        for side in (-0.06, 0.06):
            ends = (int(middle + side * tall), int(hip)), (int(middle + 1.5 * side * tall), int(foot))
            cv2.line(each, *ends, colour[2], thick, cv2.LINE_AA)


def with_people(photos: list[Photo], folder: Path) -> dict[str, np.ndarray]:
    """Write the photos as they are, with people, and with people and masks. Returns where people are, by name."""
    chance = np.random.default_rng(SEED)
    for name in ("clean", "people", "masked", f"masked/{MASKS}"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    found = {}
    for number, photo in enumerate(photos):
        picture = np.ascontiguousarray(photo.pixels[..., ::-1])
        name = f"{Path(photo.name).stem}.png"
        cv2.imwrite(str(folder / "clean" / name), picture)
        shown = np.zeros(picture.shape[:2], np.uint8)
        if number % HOLDOUT_EVERY and chance.random() < SHARE:
            draw_somebody(picture, shown, chance)
            found[name] = shown > 0
            cv2.imwrite(str(folder / "masked" / MASKS / name), 255 - cv2.dilate(shown, np.ones((5, 5), np.uint8)))
        for place in ("people", "masked"):
            cv2.imwrite(str(folder / place / name), picture)
    return found


def left_out(scene: Path, used: list[str], people: dict[str, np.ndarray]) -> dict[str, float]:
    """The shares of the people and of everything else that takes no part in a scene."""
    masks = load_file(scene / "memories.safetensors")["masks"].numpy()
    counts = np.zeros((2, 2))
    for name, shown in zip(used, masks, strict=False):  # the masks of held-out views come last
        rows, columns = cv2.imread(str(scene / "images" / name)).shape[:2]
        body = people.get(name, np.zeros((rows, columns), bool)).astype(np.float32)
        somebody = cv2.resize(body, (columns, rows), interpolation=cv2.INTER_AREA) > 0.5
        for kind, part in enumerate((somebody, ~somebody)):
            counts[kind] += (~shown[:rows, :columns][part]).sum(), part.sum()
    return dict(zip(("found", "beside"), (counts[:, 0] / np.maximum(counts[:, 1], 1)).tolist(), strict=True))


def measure(photo_set: PhotoSet, data: Path, folder: Path) -> list[dict[str, Any]]:
    """The rows of one set."""
    photos, _ = load_photos(find_photos(photo_set.photos(data)))
    people = with_people(list(photos), folder)
    rows = []
    for number, run in enumerate(RUNS):
        options = "--holdout-every", str(HOLDOUT_EVERY), "--holdout-cameras", "joint", *run.options
        report = reconstructed([folder / run.folder], folder / f"{number}.ply", *options)
        labels = {"set": photo_set.name, "use": photo_set.use, "photos": run.label, "with_people": len(people)}
        if "error" in report:
            rows.append({**labels, **report})
            continue
        shares = left_out(folder / str(number), report["views"]["used"], people)
        held = report["quality"]["heldout"]
        costs = {"seconds": report["wall"], "cpu_seconds": report["cpu_seconds"]}
        rows.append({**labels, "psnr_grey": held["psnr_grey"], "ssim": held["ssim"], **shares, **costs})
    return rows


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--keep", type=Path, help="keep photos and scenes in this folder")
    options = parser.parse()
    columns = {"dB": ".2f", "SSIM": ".3f", "found": ".0%", "beside": ".1%", "s": ".0f"}
    table, rows = Table({"set": "", "photos": "", **columns}), []
    with folder_or_scratch(options.keep) as folder:
        for photo_set in (PHOTO_SETS[name] for name in options.sets):
            for row in measure(photo_set, options.data, folder / photo_set.name.replace("/", "-")):
                rows.append(row)
                names = "psnr_grey", "ssim", "found", "beside", "seconds"
                table.add(row["set"], row["photos"], *(row.get(name) for name in names))
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
