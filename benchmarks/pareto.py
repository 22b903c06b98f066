"""Error against run time: what each setting of `querysplat reconstruct` costs and brings, and a picture of the best.

    python benchmarks/pareto.py [DATA] [--sets NAME ...] [--settings NAME ...] --json pareto.json [--figure FILE.svg]
    python benchmarks/pareto.py --json pareto.json --figure docs/images/pareto.svg --sets

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out, with joint cameras. Each
scene is one run of the command in a process of its own. Scores are of held-out photos, over black and over mid-grey (a
scene that is see-through scores less): at the working size, and at 1,600 pixels or the photos' own size. Scenes that
--json has already are not made again, so that a run can be stopped and repeated. Where photos are smaller than the
pictures of two settings, one scene stands for both. At the end come the means of the sets that were tuned on, and of
the others. Without a set there is nothing else.

Where `opensplat` is on the path, it has a row after the default's: it is trained on the same input photos with the
cameras of the default scene, and scored as that scene is. Its seconds are those of its own process, without cameras.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import fullscreen
from common import opensplat
from common.arguments import PhotoParser, folder_or_scratch
from common.output import Table, read_rows, write_rows
from common.photo_sets import PHOTO_SETS, PhotoSet
from querysplat_cli.pipeline.full_size import files_of
from querysplat_cli.pipeline.read_scene import read_scene, read_scene_gaussians
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.decoding import longer_side

from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

PIXELS = (224, 896, 1600)
"""Longer sides of the working pictures beside the default's 448."""
DEFAULT = "default"
SETTINGS: dict[str, tuple[str, ...]] = {
    DEFAULT: (),
    "feed-forward": ("--quality", "draft", "--tto", "0"),
    "20 steps": ("--quality", "draft", "--tto", "20"),
    "50 steps": ("--quality", "draft", "--tto", "50"),
    **{f"quality {name}": ("--quality", name) for name in ("draft", "high")},
    **{f"{size} px": ("--max-size", str(size)) for size in PIXELS},
    **{f"budget {seconds} s": ("--budget", str(seconds)) for seconds in (15, 30, 60, 120, 300)},
}
"""Options of `querysplat reconstruct` by the name of the point. `draft` with `auto` steps is "quality draft"."""
SIZES = {DEFAULT: 448, **{f"{size} px": size for size in PIXELS}}
"""The longer side of working pictures at most, where photos have the pixels."""
Row = dict[str, Any]
SCORE, COST = "grey, full screen, dB", "CPU s"
COLUMNS: dict[str, tuple[Callable[[Row], float], str]] = {
    "black, dB": (lambda row: row["working"]["black"], ".2f"),
    "grey, dB": (lambda row: row["working"]["grey"], ".2f"),
    "black, full screen, dB": (lambda row: row["full"]["black"], ".2f"),
    SCORE: (lambda row: row["full"]["grey"], ".2f"),
    "cc there, dB": (lambda row: row["full"]["corrected"], ".2f"),
    "SSIM there": (lambda row: row["full"]["ssim"], ".3f"),
    COST: (lambda row: row["cpu_seconds"], ".0f"),
    "s": (lambda row: row["seconds"], ".0f"),
    "GiB": (lambda row: row["gib"], ".2f"),
    "Gaussians": (lambda row: row["gaussians"], ",.0f"),
}
"""What means are taken of, and how it is printed. The first two are at the size of the working pictures, which some
settings change, so the picture shows `SCORE`."""
TICKS = (20, 50, 100, 200)
COLOURS = {"tuned on": "#0072b2", "only reported": "#d55e00"}


def same_scene(setting: str, longer: int) -> str | None:
    """The setting with smaller pictures that makes the same scene of photos whose longer side has `longer` pixels."""
    return next((other for other, size in SIZES.items() if longer <= size < SIZES.get(setting, 0)), None)


def frontier(points: Sequence[tuple[float, float]]) -> list[int]:
    """Numbers of the points (seconds, dB) that no other point beats in both, by seconds."""
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1]))
    best, found = float("-inf"), []
    for i in order:
        if points[i][1] > best:
            best = points[i][1]
            found.append(i)
    return found


def whole_sets(rows: Sequence[Row], use: str) -> list[dict[str, Row]]:
    """The rows, by setting, of each set of this use that has every setting."""
    chosen = [row for row in rows if row["use"] == use]
    settings = {row["quality"] for row in chosen}
    by_set: dict[str, dict[str, Row]] = {}
    for row in chosen:
        by_set.setdefault(row["set"], {})[row["quality"]] = row
    return [found for found in by_set.values() if len(found) == len(settings)]


def means(sets: Sequence[dict[str, Row]]) -> dict[str, Row]:
    """Means of each setting over sets that have the same ones; by `COLUMNS`."""
    return {
        name: {what: fmean(read(found[name]) for found in sets) for what, (read, _) in COLUMNS.items()}
        for name in sets[0]
    }


def best(points: dict[str, Row]) -> list[str]:
    """Settings that no other one beats in both CPU seconds and PSNR at full screen, by CPU seconds."""
    names = list(points)
    return [names[i] for i in frontier([(points[name][COST], points[name][SCORE]) for name in names])]


def summarise(rows: Sequence[Row]) -> None:
    """Print the means of each use as a table; settings that no other one beats are bold."""
    for use in COLOURS:
        if sets := whole_sets(rows, use):
            points = means(sets)
            front = best(points)
            print(f"\n{use}, {len(sets)} sets\n")
            table = Table({"setting": ""} | {what: form for what, (_, form) in COLUMNS.items()})
            for name, found in points.items():
                table.add(f"**{name}**" if name in front else name, *found.values())


def draw(rows: Sequence[Row], path: Path) -> None:
    """Mean held-out PSNR against mean CPU seconds: a panel for sets that were tuned on, and one for the others."""
    by_use = {use: found for use in COLOURS if (found := whole_sets(rows, use))}
    figure = new_figure(10.0, 4.0)
    for axis, (use, sets) in zip(figure.subplots(1, len(by_use), squeeze=False)[0], by_use.items(), strict=True):
        points = means(sets)
        places = {name: (found[COST], found[SCORE]) for name, found in points.items()}
        axis.plot(*zip(*(places[name] for name in best(points)), strict=True), color=COLOURS[use], lw=1.2)
        axis.plot(*zip(*places.values(), strict=True), "o", color=COLOURS[use], ms=4)
        axis.set_xscale("log")
        axis.set_xticks(TICKS, [str(tick) for tick in TICKS])
        axis.minorticks_off()
        axis.margins(0.2, 0.08)
        axis.set_title(f"means of {len(sets)} sets, {use}", fontsize=9)
        axis.set_xlabel("CPU seconds of the command")
        axis.set_ylabel("held-out PSNR at full screen on grey, dB")
        axis.grid(alpha=0.3)
        label(axis, places)
    save_figure(figure, path)


def label(axis: Axes, places: Mapping[str, tuple[float, float]]) -> None:
    """Names beside points, none on another; settings of one place share a text."""
    figure = axis.get_figure()
    assert figure is not None
    figure.draw_without_rendering()
    taken = [Bbox.from_bounds(*(axis.transData.transform(place) - 4), 8, 8) for place in places.values()]
    for place in dict.fromkeys(places.values()):
        names = ", ".join(name for name in places if places[name] == place)
        text = axis.annotate(names, place, (0, 0), textcoords="offset points", fontsize=7)
        for offset, side in product(((0, 5), (0, -12), (0, 14), (0, -21), (0, 23)), ("right", "left", "center")):
            text.set(position=offset, horizontalalignment=side)
            box = text.get_window_extent()
            if not box.count_overlaps(taken):
                break
        taken.append(box)


def measure(options: argparse.Namespace, rows: list[Row]) -> None:
    """Add the rows that are missing, one after another, and keep them in the file of --json."""
    done = {(row["set"], row["quality"]): row for row in rows}
    table = Table({"set": "", "use": "", "setting": ""} | {what: form for what, (_, form) in COLUMNS.items()})
    with folder_or_scratch(options.keep) as folder:
        for setting, name in product(with_peer(options.settings), options.sets):
            if (name, setting) in done:
                continue
            row = row_of(PHOTO_SETS[name], setting, options.data, folder, done)
            if row is None:
                print(f"{name}, {setting}: no scene, so no score", file=sys.stderr)
                continue
            rows.append(row)
            done[name, setting] = row
            table.add(name, row["use"], setting, *(read(row) for read, _ in COLUMNS.values()))
            write_rows(options.json, rows)


def with_peer(settings: Sequence[str]) -> list[str]:
    """The settings, and OpenSplat's row after the default's. Where the program is not there, a line says so."""
    if DEFAULT not in settings:
        return list(settings)
    if not opensplat.is_there():
        print("opensplat is not on the path, so it has no row", file=sys.stderr)
        return list(settings)
    return [each for name in settings for each in ((name, opensplat.ROW) if name == DEFAULT else (name,))]


def row_of(
    photo_set: PhotoSet, setting: str, data: Path, folder: Path, done: Mapping[tuple[str, str], Row]
) -> Row | None:
    """The row of one set and setting, from a scene in `folder`; None where there is no scene."""
    if setting == opensplat.ROW:
        found = peer(photo_set, data, folder)
    else:
        same = same_scene(setting, longer_side(photo_set.files(data)[0]))
        if same and (photo_set.name, same) in done:
            return done[photo_set.name, same] | {"quality": setting}
        found = fullscreen.measure(photo_set, setting, data, folder, None, SETTINGS[setting])
    return found and asdict(found)


def peer(photo_set: PhotoSet, data: Path, folder: Path) -> fullscreen.Row | None:
    """OpenSplat's row beside our default scene of a set, which is made again where `folder` no longer has it."""
    ply = fullscreen.scene_file(photo_set, DEFAULT, folder)
    if not ply.is_file() and not fullscreen.measure(photo_set, DEFAULT, data, folder, None, SETTINGS[DEFAULT]):
        return None
    scene, _ = read_scene(ply)
    assert scene.heldout
    trained = ply.with_name(f"{ply.stem}-opensplat.ply")
    took = opensplat.train(ply.with_suffix(""), files_of(scene, scene.views), trained)
    if took is None:
        return None
    gaussians = read_scene_gaussians(trained, scene)
    return fullscreen.Row(
        photo_set.name,
        photo_set.use,
        opensplat.ROW,
        fullscreen.scored(gaussians, scene.heldout),
        fullscreen.scored(gaussians, fullscreen.at_full_screen(scene)),
        took.seconds,
        took.cpu_seconds,
        {"opensplat": took.seconds},
        took.gib,
        len(gaussians),
    )


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--settings", nargs="*", choices=SETTINGS, default=tuple(SETTINGS), metavar="NAME")
    parser.add_argument("--figure", type=Path, help="draw means over sets into this file")
    parser.add_argument("--keep", type=Path, help="keep the scenes in this folder")
    options = parser.parse()
    rows = read_rows(options.json)
    if options.sets:
        measure(options, rows)
    summarise(rows)
    if options.figure:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
