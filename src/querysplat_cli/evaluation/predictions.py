"""Scores of other methods' outputs: a .ply with cameras, or pictures.

DIR/<split>/<case>/, or DIR/<case>/, holds one of these:
- A .ply, and a cameras.json or transforms.json in its frame, with cameras of the shown or of the whole photos by their
  names. Views that are not in that file, or all views without it, get the dataset's cameras. Of several
  .ply files the first by its path is scored, with a warning.
- Pictures of the views in any folder below, named like the photo or by its number in the dataset's list. One picture
  may serve several groups. Of several pictures with one name, that in a folder of the group's name counts. Folders in
  which methods keep the photos themselves (`PHOTO_FOLDERS`) are left out.
- A views.json beside the pictures, where they have other names: {photo's name: picture}. Then only these count.

docs/other-methods.md has an example for each system of the paper's main table.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

import torch

from querysplat_cli.evaluation.cameras import to_frame_of
from querysplat_cli.evaluation.judge import Judge, RowResult
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json, shown
from querysplat_cli.scene.cameras import PhotoCamera, same_shape
from querysplat_cli.scene.fit import resized
from querysplat_cli.scene.formats.dataset import Frame
from querysplat_cli.scene.formats.known import JSON_NAMES
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.match_cameras import cameras_of
from querysplat_cli.scene.photos import SUFFIXES, WHOLE, load_photo
from querysplat_cli.scene.views import LeftOut
from querysplat_cli.splat.conventions import EQUAL_PSNR

PHOTO_FOLDERS = {"gt", "gt-color", "ground_truth", "context"}
"""Folders beside the renders in which other methods keep input and target photos."""
NAMES_FILE = "views.json"


def score_prediction(judge: Judge, root: Path, split: str, case: str) -> RowResult:
    """Scores of another method's output for a case. Raises QuerySplatError when there is none that can be scored."""
    folder = next((place for place in (root / split / case, root / case) if place.is_dir()), None)
    if folder is None:
        raise QuerySplatError(f"{root}: nothing for {split}, {case}", f"Expected {root / split / case}.")
    scenes = sorted(folder.rglob("*.ply"))
    if scenes:
        gaussians = read_ply(scenes[0])
        why = "no camera of it is given, nor one by the dataset"
        found = judge.score_scene(gaussians, _cameras(judge, folder), why)
        if len(scenes) == 1:
            return found
        first = scenes[0].relative_to(folder)
        doubt = f"there are {len(scenes)} files of Gaussians or points, and {first} is scored: leave one there"
        return replace(found, warnings=(*found.warnings, doubt))
    pictures = _pictures(judge, folder)
    result = judge.score_pictures(
        lambda group, frame: _read(pictures[group].get(frame.name), judge.truth(frame)), "no picture of it is there"
    )
    equal = [view.frame.name for views in result.views.values() for view in views if view.scores.psnr >= EQUAL_PSNR]
    if equal:
        doubt = f"{len(equal)} pictures are equal to their photos ({equal[0]}): are they renders?"
        return replace(result, warnings=(*result.warnings, doubt))
    return result


def _pictures(judge: Judge, folder: Path) -> dict[str, dict[str, Path]]:
    """The file of each view, by group and by the photo's name."""
    if (folder / NAMES_FILE).is_file():
        named = _named(folder)
        return {
            group: {frame.name: named[frame.name] for frame in frames if frame.name in named}
            for group, frames in judge.groups.items()
        }
    files = [
        file
        for file in (found.relative_to(folder) for found in sorted(folder.rglob("*")))
        if file.suffix.lower() in SUFFIXES and not PHOTO_FOLDERS & set(file.parts)
    ]
    if not files:
        raise QuerySplatError(f"{folder}: neither a .ply nor pictures in it", "See docs/other-methods.md.")
    return {
        group: {frame.name: folder / file for frame in frames if (file := _picture_file(files, group, frame))}
        for group, frames in judge.groups.items()
    }


def _named(folder: Path) -> dict[str, Path]:
    """The pictures by photo that views.json lists."""
    listed = read_json(folder / NAMES_FILE, "Write it again: {photo's name: picture}.")
    if not isinstance(listed, dict) or not all(isinstance(file, str) for file in listed.values()):
        raise QuerySplatError(f"{folder / NAMES_FILE}: not of the form {{photo's name: picture}}", "Write it again.")
    found = {name: folder / file for name, file in listed.items()}
    for name, file in found.items():
        if not (file.is_file() and file.resolve().is_relative_to(folder.resolve())):
            raise QuerySplatError(
                f"{folder / NAMES_FILE}: {shown(name)} has no picture {shown(listed[name])} below that folder",
                "Correct the name, or leave the photo out.",
            )
    return found


def _cameras(judge: Judge, folder: Path) -> dict[str, PhotoCamera]:
    """Cameras of the shown photos in the .ply's frame."""
    file = next((folder / name for name in JSON_NAMES if (folder / name).is_file()), None)
    if file is None:
        return dict(judge.known)
    found = cameras_of({name: PurePosixPath(name) for name in judge.photos}, read_transforms(file))
    given: dict[str, PhotoCamera] = {}
    for name, camera in found.items():
        photo, cut = judge.photos[name]
        of_shown = same_shape((camera.height, camera.width), (cut.height, cut.width))
        given[name] = camera if of_shown else judge.protocol.shown_camera(camera, photo)
    return _completed(given, judge.known)


def _completed(given: dict[str, PhotoCamera], known: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    if known.keys() <= given.keys() or len(given.keys() & known.keys()) < 2:
        return given
    return {**to_frame_of({name: camera for name, camera in given.items() if name in known}, known), **given}


def _picture_file(files: list[Path], group: str, frame: Frame) -> Path | None:
    """One of `files`, whose paths are those below the case's folder."""
    named = [file for file in files if file.stem == Path(frame.name).stem]
    named = named or [file for file in files if file.stem.isdecimal() and int(file.stem) == frame.index]
    return next((file for file in named if group in file.parts), named[0] if named else None)


def _read(file: Path | None, truth: torch.Tensor) -> torch.Tensor | None:
    if file is None:
        return None
    photo = load_photo(file, file.name, WHOLE)
    if isinstance(photo, LeftOut):
        raise QuerySplatError(f"{file}: {photo.why}", "Write it again.")
    height, width = truth.shape[1:]
    if not same_shape((photo.height, photo.width), (height, width)):
        raise QuerySplatError(
            f"{file} is {photo.width} × {photo.height}, the target {width} × {height}",
            "Pictures must show what the protocol scores; they may only be larger or smaller.",
        )
    image = torch.from_numpy(photo.pixels).permute(2, 0, 1).float() / 255
    return resized(image, (height, width))
