"""What depth maps that come with photos bring to a scene.

    python benchmarks/depth_maps.py [--rooms 1 2 3] [--photos 11] [--json results.json] [--keep DIR]

Photos are ray-cast pictures of procedural rooms, so their depth is known. The walls of each room are as they are, of
bricks or rough plaster, or plain, as in most homes. Every 4th photo is held out, and the cameras of all
are found together. Each row is one run of the command: without depth maps, with maps like those of a phone's LiDAR
(millimetres at a fifth of the photo's size, noise of 1 %), and with maps like those of a network (inverse depth of an
unknown scale and shift for each photo, blurred). PSNR is over grey and SSIM over black, of held-out photos.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from common.arguments import folder_or_scratch
from common.command import reconstructed
from common.output import Table, write_json
from common.samples import HOLDOUT_EVERY, SEED
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.solids import Scene

import cv2
import numpy as np

SIZE = (360, 480)
LIDAR_NOISE = 0.01
LIDAR_STEP = 5
"""Photo pixels of one pixel of the maps."""
NETWORK_BLUR = 2.0
"""Pixels."""


def of_lidar(depth: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """Millimetres [height / LIDAR_STEP, width / LIDAR_STEP]."""
    coarse = depth[LIDAR_STEP // 2 :: LIDAR_STEP, LIDAR_STEP // 2 :: LIDAR_STEP]
    return (1000 * coarse * chance.normal(1, LIDAR_NOISE, coarse.shape)).clip(0, 65535).astype(np.uint16)


def of_network(depth: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """The reciprocal of inverse depth [height, width] that has another scale and zero for each photo."""
    blurred = cv2.GaussianBlur(1 / depth, (0, 0), NETWORK_BLUR)
    return (1 / (chance.uniform(0.5, 2) * blurred + chance.uniform(0.02, 0.1))).astype(np.float32)


SENSORS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray] | None] = {
    "none": None,
    "LiDAR": of_lidar,
    "network": of_network,
}


def furnished(room: int, walls: str) -> Scene:
    """A room; with `walls` "plain", walls and ceiling have one colour each."""
    scene = make_room(room)
    if walls != "plain":
        return scene
    solids = (replace(each, paint="plain") if each.paint in ("brick", "plaster") else each for each in scene.solids)
    return replace(scene, solids=tuple(solids))


def take_photos(room: int, walls: str, count: int, folder: Path) -> None:
    """Write so many photos of a room into `photos`, and the maps of each sensor into `SENSOR-maps`."""
    chance = np.random.default_rng([SEED, room])
    scene = furnished(room, walls)
    pictures, depth = cast(scene, walk(scene, count, room).resized(*SIZE))
    for name in ("photos", *(f"{sensor}-maps" for sensor, make in SENSORS.items() if make)):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number, (picture, z) in enumerate(zip(pictures, depth.numpy(), strict=True)):
        colours = (picture * 255).round().byte().permute(1, 2, 0).numpy()
        cv2.imwrite(str(folder / "photos" / f"{number:02}.png"), np.ascontiguousarray(colours[..., ::-1]))
        for sensor, make in SENSORS.items():
            if make:
                np.save(folder / f"{sensor}-maps" / f"{number:02}.npy", make(z, chance))


def measure(room: int, walls: str, count: int, folder: Path) -> list[dict[str, Any]]:
    """The rows of one room."""
    take_photos(room, walls, count, folder)
    rows = []
    for sensor, make in SENSORS.items():
        options = ["--holdout-every", str(HOLDOUT_EVERY), "--holdout-cameras", "joint"]
        options += ["--depth-maps", str(folder / f"{sensor}-maps")] if make else []
        report = reconstructed([folder / "photos"], folder / f"{sensor}.ply", *options)
        labels = {"room": room, "photos": count, "walls": walls, "maps": sensor}
        if "error" in report:
            rows.append({**labels, **report})
            continue
        held, maps = report["quality"]["heldout"], report["depth_maps"] or {}
        used = {"used": maps.get("used"), "difference": maps.get("difference")}
        costs = {"seconds": report["wall"], "cpu_seconds": report["cpu_seconds"]}
        rows.append({**labels, "psnr_grey": held["psnr_grey"], "ssim": held["ssim"], **used, **costs})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", nargs="*", type=int, default=[1, 2, 3], metavar="SEED")
    parser.add_argument("--photos", type=int, default=11, help="of each room, those that are held out among them")
    parser.add_argument("--json", type=Path, help="also write the results here")
    parser.add_argument("--keep", type=Path, help="keep photos, maps and scenes in this folder")
    options = parser.parse_args()
    columns = {"dB": ".2f", "SSIM": ".3f", "used": "", "difference": ".1%", "s": ".0f"}
    table, rows = Table({"room": "", "walls": "", "maps": "", **columns}), []
    with folder_or_scratch(options.keep) as folder:
        for room, walls in product(options.rooms, ("patterned", "plain")):
            for row in measure(room, walls, options.photos, folder / f"{room}-{walls}"):
                rows.append(row)
                names = "psnr_grey", "ssim", "used", "difference", "seconds"
                table.add(room, walls, row["maps"], *(row.get(name) for name in names))
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
