"""Captured scenes of DL3DV, nerfstudio, COLMAP, LLFF, our scene folder and plain photos, as folders or zips."""

import shutil
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable
from pathlib import Path, PurePath

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.colmap import MODEL_FOLDERS, read_colmap
from querysplat_cli.scene.formats.listed_pictures import inside, listed_picture
from querysplat_cli.scene.formats.llff import POSES_BOUNDS, read_poses_bounds
from querysplat_cli.scene.formats.transforms import listed_paths, read_transforms
from querysplat_cli.scene.formats.transforms_frame import is_rigid
from querysplat_cli.scene.photo_names import short_names
from querysplat_cli.scene.photos import SUFFIXES, natural_key

DATASET_FOLDERS = ("images_4", "images_2", "images", "images_8")
"""DL3DV's sizes in the order of preference: 960 × 540 is what its users evaluate with."""
HOMES = ("", "nerfstudio", "colmap", "gaussian_splat")
"""Where in a scene's folder DL3DV's releases (10K, Benchmark and sample) keep pictures and cameras."""
SCENE_DEPTH = 2
"""Scenes are at most this many folders below the one that the user gives: subset / hash."""
MAC_NOTES = "__MACOSX"
"""A folder that macOS adds to zips, with a file of its own notes for each file."""
MODEL_FILES = tuple(f"{part}{suffix}" for part in ("cameras", "images", "points3D") for suffix in (".bin", ".txt"))


@dataclass(frozen=True)
class ZipMember:
    """A file in a zip."""

    archive: Path
    member: str


@dataclass(frozen=True)
class Frame:
    """One photo of a scene: its number in the dataset's own list, its short name, its folder's name, and the file."""

    index: int
    name: str
    folder: str
    file: Path | ZipMember


@dataclass(frozen=True)
class CapturedScene:
    """The photos of one scene in natural order, those that are on disk, and the dataset's cameras by name.

    `cameras` is empty where the dataset has none; cameras whose matrix is no rigid motion are not in it. `notes` are
    phrases for the user about what is missing or unusual. `fault` is why the scene cannot be read; it has no photos
    then.
    """

    name: str
    frames: tuple[Frame, ...]
    cameras: dict[str, PhotoCamera]
    notes: tuple[str, ...]
    fault: str = ""


def find_scenes(places: Sequence[Path], pictures: str = DATASET_FOLDERS[0]) -> list[CapturedScene]:
    """Every scene in `places`: scene folders, zips of scenes, or folders of those, by name in natural order.

    `pictures` is the preferred folder of pictures (images_4, …). Where a scene does not have it another one is taken,
    with a note. One of several scenes in a folder that cannot be read has a `fault`. Scenes of one name get those of
    their parents, too. Raises QuerySplatError when a place is missing, damaged or holds no scene, and when a scene is
    given twice.
    """
    found: list[tuple[PurePath, CapturedScene]] = []
    for place in places:
        if not place.exists():
            raise QuerySplatError(f"{place}: no such file or folder", "Give a scene, or a folder of scenes.")
        here = list(_scenes(_opened(place), _unzipped(place.resolve()), pictures, SCENE_DEPTH))
        if not here:
            raise QuerySplatError(
                f"{place}: no scene in it", "A scene is a folder of pictures, or has images_4 and a transforms.json."
            )
        if all(scene.fault for _, scene in here):
            raise QuerySplatError(here[0][1].fault, "Download or export the scene again.")
        found += here
    names = _distinct_names([where for where, _ in found])
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        why = f"two scenes are called {twice[0]}"
        raise QuerySplatError(why, "Give each scene once, and each a name of its own.")
    scenes = [replace(scene, name=name) for name, (_, scene) in zip(names, found, strict=True)]
    return sorted(scenes, key=lambda scene: natural_key(Path(scene.name)))


def _distinct_names(places: Sequence[PurePath]) -> list[str]:
    """The last part of each path; of paths that share it, as many more parts as tell them apart.

    DL3DV's folders in a scene do not count then: `a/nerfstudio` and `b/nerfstudio` are a and b.
    """
    names = [place.name for place in places]
    for name in [name for name, count in Counter(names).items() if count > 1]:
        rows = [row for row, place in enumerate(places) if place.name == name]
        longer = short_names([places[row].parent if name in HOMES else places[row] for row in rows])
        for row, path in zip(rows, longer, strict=True):
            names[row] = path.replace("/", "_")
    return names


def fetch(frames: Sequence[Frame], scratch: Path) -> list[Path]:
    """A file on disk for each frame; those in a zip are copied into the folder `scratch`."""
    files = []
    for frame in frames:
        if isinstance(frame.file, Path):
            files.append(frame.file)
            continue
        copy = scratch / f"{frame.index:06d}" / Path(frame.file.member).name
        copy.parent.mkdir(parents=True, exist_ok=True)
        with (
            _unpacking(frame.file.archive),
            zipfile.ZipFile(frame.file.archive) as archive,
            archive.open(frame.file.member) as source,
            copy.open("wb") as target,
        ):
            shutil.copyfileobj(source, target)
        files.append(copy)
    return files


@contextmanager
def _unpacking(file: object) -> Iterator[None]:
    """Inside, what is wrong with the bytes of a zip becomes an error that names `file`, the zip or a part of it."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise QuerySplatError(f"{file}: cannot be unpacked: {error}", "Download the zip again.") from error


def _opened(place: Path) -> Traversable:
    if place.is_dir():
        return place
    try:
        return zipfile.Path(place)
    except (zipfile.BadZipFile, OSError) as error:
        raise QuerySplatError(f"{place}: no folder, and no zip: {error}", "Give a folder or a .zip.") from None


def _unzipped(place: PurePath) -> PurePath:
    stem = place.name.removesuffix(".zip")
    return place.with_name(stem) if stem else place


def _scenes(place: Traversable, where: PurePath, pictures: str, depth: int) -> Iterator[tuple[PurePath, CapturedScene]]:
    """The scenes in `place`, with their paths: `where` this is, and folders in it."""
    scene = _scene(place, where.name, pictures)
    if scene:
        yield where, scene
    elif depth:
        for entry in sorted(place.iterdir(), key=lambda entry: entry.name):
            if entry.name.startswith(".") or entry.name == MAC_NOTES:
                continue
            yield from _inner_scenes(entry, where / entry.name, pictures, depth - 1)


def _inner_scenes(
    entry: Traversable, where: PurePath, pictures: str, depth: int
) -> Sequence[tuple[PurePath, CapturedScene]]:
    """The scenes in a folder or zip in a folder of scenes. One that cannot be read leaves the others alone."""
    where = where if entry.is_dir() else _unzipped(where)
    try:
        if entry.is_dir():
            return list(_scenes(entry, where, pictures, depth))
        if isinstance(entry, Path) and entry.suffix.lower() == ".zip" and entry.is_file():
            return list(_scenes(_opened(entry), where, pictures, depth))
    except QuerySplatError as error:
        return [(where, CapturedScene(where.name, (), {}, (f"left out: {error.message}",), error.message))]
    return []


def _scene(place: Traversable, name: str, pictures: str) -> CapturedScene | None:
    for home in (inside(place, part) for part in HOMES):
        folders = [folder for folder in (pictures, *DATASET_FOLDERS) if inside(home, folder).is_dir()]
        if (home / "transforms.json").is_file() or folders:
            return _read(home, name, folders or [""], pictures)
    if any(_is_picture(entry) for entry in place.iterdir()):
        return _read(place, name, [""], pictures)
    return None


def _read(home: Traversable, name: str, folders: Sequence[str], wanted: str) -> CapturedScene:
    """The scene with the pictures of the first of `folders` that has one which the dataset lists."""
    notes = []
    cameras, paths = _cameras(home)
    folder = folders[0]
    if cameras:
        read = ((each, _listed_frames(home, each, cameras, paths)) for each in folders)
        folder, frames = next(filter(lambda found: found[1], read), (folder, []))
        if folder not in ("", wanted):
            missing = "none of the listed pictures in" if wanted in folders else "no"
            notes.append(f"{missing} {wanted}: its pictures are those of {folder}")
        if len(frames) < len(cameras):
            notes.append(f"{len(cameras) - len(frames)} of {len(cameras)} listed frames are not on disk")
    else:
        entries = filter(_is_picture, inside(home, folder).iterdir())
        files = sorted(entries, key=lambda entry: natural_key(Path(entry.name)))
        frames = [_frame(index, entry.name, folder, entry) for index, entry in enumerate(files)]
    rigid = {short: camera for short, camera in cameras.items() if is_rigid(camera.w2c)}
    if len(rigid) < len(cameras):
        notes.append(f"{len(cameras) - len(rigid)} cameras are no rigid motions, and not used")
    ordered = sorted(frames, key=lambda frame: natural_key(Path(frame.name)))
    return CapturedScene(name, tuple(ordered), rigid, tuple(notes))


def _listed_frames(home: Traversable, folder: str, names: Iterable[str], paths: Sequence[str]) -> list[Frame]:
    """The frames with these short `names` and listed `paths` whose pictures are there."""
    place, frames = inside(home, folder), []
    for index, (short, path) in enumerate(zip(names, paths, strict=True)):
        # The folder in the file is that of the full-size pictures, which often are not there.
        candidates = (place, path), (place, short), (home, path)
        file = next(filter(None, (listed_picture(*candidate) for candidate in candidates)), None)
        if file is not None:
            frames.append(_frame(index, short, folder, file))
    return frames


def _frame(index: int, name: str, folder: str, file: Traversable) -> Frame:
    if isinstance(file, zipfile.Path):
        return Frame(index, name, folder, ZipMember(Path(str(file.root.filename)), file.at))
    return Frame(index, name, folder, Path(str(file)))


def _cameras(home: Traversable) -> tuple[dict[str, PhotoCamera], list[str]]:
    """The dataset's cameras by short name, in its order, and the paths that it gives for the pictures."""
    with scratch_folder() as scratch:
        try:
            return _copied_cameras(home, scratch)
        except QuerySplatError as error:
            # The user knows the dataset, and not the copy in it.
            raise QuerySplatError(error.message.replace(str(scratch), str(home)), error.hint, error.code) from error


def _copied_cameras(home: Traversable, scratch: Path) -> tuple[dict[str, PhotoCamera], list[str]]:
    if (home / "transforms.json").is_file():
        return _listed(_copied(home / "transforms.json", scratch), home)
    for part in MODEL_FOLDERS:
        model = inside(home, part)
        files = [model / file for file in MODEL_FILES if (model / file).is_file()] if model.is_dir() else []
        if any(file.name.startswith("images.") for file in files):
            for file in files:
                _copied(file, scratch)
            cameras = read_colmap(scratch)
            return cameras, [camera.file for camera in cameras.values()]
    # Our scene folder's. The original 3DGS writes another kind of cameras.json next to a COLMAP model.
    if (home / "cameras.json").is_file():
        return _listed(_copied(home / "cameras.json", scratch), home)
    if (home / POSES_BOUNDS).is_file():
        cameras = read_poses_bounds(_copied(home / POSES_BOUNDS, scratch), home=home)
        return cameras, list(cameras)
    return {}, []


def _listed(listing: Path, home: Traversable) -> tuple[dict[str, PhotoCamera], list[str]]:
    return read_transforms(listing, home=home), list(listed_paths(listing).values())


def _copied(file: Traversable, folder: Path) -> Path:
    copy = folder / file.name
    with _unpacking(file):
        copy.write_bytes(file.read_bytes())
    return copy


def _is_picture(entry: Traversable) -> bool:
    return entry.is_file() and not entry.name.startswith(".") and Path(entry.name).suffix.lower() in SUFFIXES
