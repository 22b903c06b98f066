"""Files of Gaussians of every kind that is read or written, in the axes of a .ply."""

from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePath

import torch

from querysplat_cli.runtime.choices import SpzVersion
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.scene.files import refuse_replacing, with_name
from querysplat_cli.scene.formats.compressed import check_spz, read_spz, write_spz
from querysplat_cli.scene.formats.gltf import read_glb, write_glb
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.formats.sog import read_sog, write_sog
from querysplat_cli.scene.formats.streamed_index import INDEX_NAME
from querysplat_cli.scene.formats.streamed_sog import read_streamed
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.transform import transform_gaussians

Writer = Callable[[Path, Gaussians], int]


def _read_glb(path: Path) -> Gaussians:
    """All meshes, in the frame of the file."""
    return joined(*(transform_gaussians(part, place) if place else part for part, place in read_glb(path)))


READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": read_ply,
    ".spz": read_spz,
    ".sog": read_sog,
    ".glb": _read_glb,
}
WRITERS: dict[str, Writer] = {
    ".ply": write_ply,
    ".spz": write_spz,
    ".sog": write_sog,
    ".glb": write_glb,
}
GIVE = f"Give a {', '.join(READERS)}."
Y_UP = {".spz", ".glb"}
"""Kinds whose specification says that y points up."""
STREAMED = ".lod"
"""Suffix of the folder of a streamed SOG."""
COMPRESSED_PLY = ".compressed.ply"
FLIPPED = Sim3(1.0, torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), torch.zeros(3).double())
"""From the y-down axes of .ply files to axes whose y points up. It is its own inverse."""


def is_streamed(path: Path) -> bool:
    """Whether `path` names a streamed SOG: its folder, or the lod-meta.json in it."""
    return path.suffix.lower() == STREAMED or path.name == INDEX_NAME


def bytes_of(path: Path) -> int:
    """The size of a file of Gaussians, or of all files of a streamed SOG."""
    if not is_streamed(path):
        return path.stat().st_size
    folder = path if path.is_dir() else path.parent
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def refuse_replacing_scene(path: Path, output: Path, *, instead: str) -> None:
    """Raise QuerySplatError when `output` would replace a part of the scene `path`, as `refuse_replacing` does."""
    file = file_of_scene(with_name(path))
    parts = [part for part in (file, folder_of_scene(file)) if part.exists()]
    refuse_replacing(parts, [output], instead=instead)


def read_gaussians(path: Path) -> Gaussians:
    """The Gaussians of a .ply, .spz, .sog or .glb, or the finest ones of a streamed SOG.

    Raises QuerySplatError when the file is missing, of another kind, damaged or empty, and MissingPart without the
    package for its kind.
    """
    if is_streamed(path):
        return read_streamed(path)
    kind = path.suffix.lower()
    if kind not in READERS:
        raise _no_gaussians(path)
    if not path.is_file():
        raise _no_file(path)
    gaussians = READERS[kind](path)
    return transform_gaussians(gaussians, FLIPPED) if kind in Y_UP else gaussians


def _no_file(path: Path) -> QuerySplatError:
    """The error where `path` is missing, which may be what `file_of_scene` made of another file or of a folder."""
    given = path.with_suffix("")
    if given.is_file():
        return _no_gaussians(given)
    levels = path.with_suffix(STREAMED)
    if levels.is_dir():
        return QuerySplatError(f"{path}: no such file", f"Give {levels}, which has levels of detail of that name.")
    of_photos = f" If {given} has photos, `querysplat reconstruct {given}` makes a scene of them."
    return QuerySplatError(f"{path}: no such file", f"{GIVE}{of_photos if given.is_dir() else ''}")


def _no_gaussians(path: Path) -> QuerySplatError:
    return QuerySplatError(f"{path}: not a kind of file for Gaussians", GIVE)


def write_gaussians(path: Path, gaussians: Gaussians, spz_version: SpzVersion = "3") -> int:
    """Write a .ply, .spz, .sog or .glb, whole or not at all; returns how many Gaussians are in it (the finite ones)."""
    writers: dict[str, Writer] = {**WRITERS, ".spz": partial(write_spz, version=int(spz_version))}
    kind = path.suffix.lower()
    return writers[kind](path, transform_gaussians(gaussians, FLIPPED) if kind in Y_UP else gaussians)


def check_target(path: Path) -> None:
    """Raise QuerySplatError unless `path` names a kind of file that is written, and no folder; worth doing first."""
    kind = path.suffix.lower()
    if path.name.lower().endswith(COMPRESSED_PLY):
        raise QuerySplatError(f"{path}: {COMPRESSED_PLY} is a format of PlayCanvas, which is not written", "Use .spz.")
    if is_streamed(path):
        raise QuerySplatError(f"{path}: levels of detail are not written here", "Write a .ply, and convert it.")
    if kind not in WRITERS:
        levels = f" `querysplat convert` also writes {STREAMED}."
        raise QuerySplatError(f"{path}: not a kind of file for Gaussians", f"Use {', '.join(WRITERS)}.{levels}")
    if path.is_dir():
        raise QuerySplatError(f"{path}: a folder has that name", "Choose another output.")
    if kind == ".spz":
        check_spz()


def file_of_scene(path: Path) -> Path:
    """The Gaussians of a scene; `path` is its folder, or the file itself.

    Of several files beside a folder, that of the kind that its report names is the scene's, else the .ply.
    """
    if is_streamed(path) or (path.suffix.lower() in READERS and not path.is_dir()):
        return path
    files = _files_beside(path)
    if len(files) > 1:
        kind = _reported_kind(path)
        return min(files, key=lambda file: (file.suffix != kind, file.suffix.lower() != kind.lower()))
    return files[0] if files else path.with_name(f"{path.name}.ply")


def _files_beside(folder: Path) -> list[Path]:
    """The files of Gaussians beside a scene folder, in the order of `READERS`. Suffixes may have capital letters."""
    kinds = list(READERS)
    try:
        beside = sorted(folder.parent.iterdir())
    except OSError:
        return []
    files = [file for file in beside if file.stem == folder.name and file.suffix.lower() in kinds and file.is_file()]
    return sorted(files, key=lambda file: kinds.index(file.suffix.lower()))


def _reported_kind(folder: Path) -> str:
    """The suffix of the Gaussians in a scene folder's report; "" where it has none that can be read."""
    try:
        report = read_json(folder / "report.json")
    except QuerySplatError:
        return ""
    return PurePath(str(report.get("ply"))).suffix if isinstance(report, dict) else ""


def folder_of_scene(path: Path) -> Path:
    """The folder beside a scene's Gaussians; `path` is that file, or the folder itself."""
    if is_streamed(path):
        folder = path.parent if path.name == INDEX_NAME else path
        return folder.with_suffix("") if folder.suffix.lower() == STREAMED else folder
    return path.with_suffix("") if path.suffix.lower() in READERS and not path.is_dir() else path
