"""What a long run has reached, in a hidden folder beside its output until it is done.

.scene.ply.unfinished/
  made_of.json             what each stage was made of: photos and settings
  cameras.pt
  inputs.views             their pictures, where there are several regions (`scene/filed_views.py`); heldout.views
  region-1/ …              `regions/task.py`

The name is no draft's (`scene/drafts.py`), so no other run sweeps it. The same command goes on with it. A stage that
was made of something else is removed, with all later ones.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import querysplat_cli
from querysplat_cli.encoders.holdout import PosedSplit
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.scene.filed_views import FiledViews
from querysplat_cli.scene.files import atomic_path, can_be_named, sole_writer, without_steps
from querysplat_cli.scene.formats.known import find_known_cameras
from querysplat_cli.scene.masks import mask_file
from querysplat_cli.scene.views import Photo, Views

Part = TypeVar("Part")
MADE_OF, CAMERAS, REGION = "made_of.json", "cameras.pt", "region-"
OF_CAMERAS = (
    "holdout_every", "holdout_cameras", "film_frames", "max_size", "max_views", "fit", "preset", "encoder", "matcher",
    "weights", "precision", "poses", "lens", "overlays", "seed", "keep_everything", "device",
)  # fmt: skip
"""Settings that the cameras depend on."""
OF_FILES = ("inputs", "ply", "force", "frame", "metres_by", "backdrop", "cluster")
"""Settings that change neither cameras nor regions; `inputs` stand for photos, which are compared themselves."""


def is_long(settings: ReconstructSettings, photos: int) -> bool:
    """Whether what a run with so many photos reaches is kept until it is done.

    So it is where an earlier run of the same output left something: nobody else uses or removes that.
    """
    many = photos >= PIPELINE_POLICY.long_run_photos or (settings.regions or 1) > 1
    return many or _working_folder(settings).is_dir()


@dataclass(frozen=True)
class Unfinished:
    """The working folder of this run. `notes` say, for the user, what it goes on with or makes again."""

    folder: Path
    notes: tuple[str, ...]

    def cameras(self, find: Callable[[], Part]) -> Part:
        """The cameras of the folder; without any, what `find` returns, which is kept."""
        found: Part | None = read_part(self.folder / CAMERAS)
        if found is None:
            found = find()
            write_part(self.folder / CAMERAS, found)
        return found

    def put_away(self, cameras: PosedSplit) -> PosedSplit:
        """The same cameras with pictures that are in memory only while they are looked at."""
        inputs = replace(cameras.inputs, views=self.filed("inputs", cameras.inputs.views))
        if cameras.heldout is None:
            return replace(cameras, inputs=inputs)
        views, theirs = cameras.heldout
        return replace(cameras, inputs=inputs, heldout=(self.filed("heldout", views), theirs))

    def filed(self, name: str, views: Views) -> FiledViews:
        """`views` in a file of this name in the folder."""
        return FiledViews(views, self.folder / f"{name}.views")

    def region(self, number: int) -> Path:
        """The folder of one region."""
        folder = self.folder / f"{REGION}{number}"
        folder.mkdir(exist_ok=True)
        return folder


def check_name(settings: ReconstructSettings) -> None:
    """Raise QuerySplatError where the name of `settings.ply` is too long for that of a working folder."""
    if not can_be_named(_working_folder(settings)):
        raise QuerySplatError(f"{settings.ply}: the name of the output is too long", "Choose a shorter one.")


@contextmanager
def unfinished(settings: ReconstructSettings, photos: Sequence[Photo], size: int) -> Iterator[Unfinished]:
    """The working folder of `settings.ply`, held for this process.

    At the end it is removed; on an exception it stays, if a stage is complete. `size` is that of the working pictures.
    Raises QuerySplatError where another process makes the same scene.
    """
    folder = _working_folder(settings)
    folder.mkdir(parents=True, exist_ok=True)
    with sole_writer(folder):
        try:
            yield Unfinished(folder, _notes(folder, _made_of(settings, photos, size)))
            shutil.rmtree(folder)
        finally:
            if (folder / CAMERAS).is_file():
                signals.keep(f"What is finished is kept in {folder}, and the same command goes on with it.")
            elif folder.is_dir():
                shutil.rmtree(folder, ignore_errors=True)


def _working_folder(settings: ReconstructSettings) -> Path:
    place = without_steps(settings.ply)
    return place.parent / f".{place.name}.unfinished"


def _made_of(settings: ReconstructSettings, photos: Sequence[Photo], size: int) -> dict[str, dict[str, Any]]:
    given = {name: str(value) for name, value in asdict(settings).items() if name not in OF_FILES}
    cameras = {name: given.pop(name) for name in OF_CAMERAS}
    seen = {
        "photos": [[photo.name, photo.pts, _state(photo.path)] for photo in photos],
        "masks": [_state(mask_file(photo.path)) for photo in photos],
        "working size": size,
        "the files of --poses": _states_of_poses(settings.poses) if settings.poses else None,
    }
    maps = [_state(photo.depth_map) for photo in photos]
    return {"cameras": {"version": querysplat_cli.__version__, **seen, **cameras}, "regions": {**given, "maps": maps}}


def _state(file: Path | None) -> list[int] | None:
    """Size and time of a file; None where there is none."""
    with suppress(OSError):
        state = os.stat(file) if file else None
        return state and [state.st_size, state.st_mtime_ns]
    return None


def _states_of_poses(poses: Path) -> dict[str, list[int] | None]:
    """Of the file that cameras were read from, or of each file of a model of COLMAP."""
    source = find_known_cameras(poses)
    return {file.name: _state(file) for file in (sorted(source.iterdir()) if source.is_dir() else [source])}


def _notes(folder: Path, made_of: dict[str, dict[str, Any]]) -> tuple[str, ...]:
    """Remove the stages that were made of something else, and say so."""
    before = _made_of_before(folder)
    changed = {stage: _changes(before.get(stage, {}), parts) for stage, parts in made_of.items()}
    kept, regions = (folder / CAMERAS).is_file(), sorted(folder.glob(f"{REGION}*"))
    done = sum((region / "scene.pt").is_file() for region in regions)
    if changed["cameras"]:
        (folder / CAMERAS).unlink(missing_ok=True)
    if changed["cameras"] or changed["regions"]:
        for region in regions:
            shutil.rmtree(region)
    # After the removals: a run that is killed between them would leave old stages with the values of new ones.
    with atomic_path(folder / MADE_OF) as draft:
        draft.write_text(json.dumps(made_of, indent=1) + "\n")
    if not kept:
        return ()
    removed = " and ".join([*(["cameras"] if changed["cameras"] else []), *(["regions"] if regions else [])])
    if not before:
        return (f"what an unfinished run was made of is not known: its {removed} are made again",)
    if changed["cameras"] or (changed["regions"] and regions):
        why = ", ".join([*changed["cameras"], *changed["regions"]])
        return (f"an unfinished run had other values of {why}: its {removed} are made again",)
    made = f" and {done} region{'s' if done > 1 else ''}" if done else ""
    return (f"went on with the cameras{made} of an unfinished run",)


def _made_of_before(folder: Path) -> dict[str, Any]:
    """What the run before wrote; empty where that is missing or damaged."""
    with suppress(QuerySplatError):
        found = read_json(folder / MADE_OF, "") if (folder / MADE_OF).is_file() else {}
        return found if isinstance(found, dict) else {}
    return {}


def _changes(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names of the parts that differ, as the user writes them."""
    names = [name for name in now if before.get(name) != now[name]]
    return [
        f"--{name.replace('_', '-')}" if name in ReconstructSettings.__dataclass_fields__ else name for name in names
    ]
