"""Which photos of which scenes are inputs and which are targets: the authors' splits, and index files.

The release's file is {dataset_path, total_samples, num_input_views, scale, samples: [{scene_id, input_views,
interp_views, extrap_views}]}, each view {path, frame_index}. An index file, as TokenGS and DepthSplat
use it, is {scene: {context: [...], target: [...]}} of positions in the scene's list of frames; its targets hold
the inputs and frames beyond them, which are separated here.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.scene.files import atomic_path, write_json
from querysplat_cli.scene.formats.dataset import CapturedScene, Frame

GROUPS = ("input", "interp", "extrap")
"""Input views, interpolation targets and extrapolation targets of a case."""


@dataclass(frozen=True)
class FrameRef:
    """A frame in a split: its path below the dataset's parent folder ("" in index files) and its number."""

    path: str
    frame_index: int


@dataclass(frozen=True)
class Case:
    """One reconstruction and its targets. `name` is unique in its split."""

    name: str
    scene: str
    groups: dict[str, tuple[FrameRef, ...]]

    @property
    def inputs(self) -> tuple[FrameRef, ...]:
        return self.groups["input"]


@dataclass(frozen=True)
class Split:
    """Cases of one number of inputs and one scale ("" where the file has no scales)."""

    name: str
    dataset: str
    views: int
    scale: str
    cases: tuple[Case, ...]


def read_splits(path: Path) -> list[Split]:
    """The splits in a file of either form, or in every .json of a folder.

    Raises QuerySplatError for a file in neither form, or with a path that leaves the dataset.
    """
    if path.is_dir():
        files = sorted(file for file in path.glob("*.json") if not file.name.endswith(".index.json"))
        if not files:
            raise QuerySplatError(f"{path}: no .json in it", "Give split files, or a folder of them.")
        return [split for file in files for split in read_splits(file)]
    content = read_json(path, "Give a split file.")
    try:
        return [_read_release(path.stem, content)] if "samples" in content else _read_index(path.stem, content)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise QuerySplatError(
            f"{path}: neither a split file nor an index file ({type(error).__name__}: {error})",
            "Give a file with `samples`, or one of the form {scene: {context: [...], target: [...]}}.",
        ) from None


def write_split(path: Path, split: Split) -> None:
    """Write `split` in the release's form."""
    content = {
        "dataset_path": split.dataset,
        "total_samples": len(split.cases),
        "num_input_views": split.views,
        "scale": split.scale,
        "samples": [
            {
                "scene_id": case.scene,
                **{f"{group}_views": [vars(ref) for ref in case.groups[group]] for group in GROUPS},
            }
            for case in split.cases
        ],
    }
    write_json(path, content)


def write_index(path: Path, split: Split) -> None:
    """Write the first case of each scene in the TokenGS and DepthSplat form, which holds no more than one."""
    content: dict[str, dict[str, list[int]]] = {}
    for case in split.cases:
        context = [ref.frame_index for ref in case.inputs]
        target = sorted(ref.frame_index for group in GROUPS for ref in case.groups[group])
        content.setdefault(case.scene, {"context": context, "target": target})
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(content) + "\n")


def spacing(split: Split) -> str:
    """In words, how many frames lie between neighbouring inputs of a split's cases."""
    steps = [
        after.frame_index - before.frame_index
        for case in split.cases
        for before, after in pairwise(sorted(case.inputs, key=lambda ref: ref.frame_index))
    ]
    if not steps:
        return "one input each"
    return (
        f"inputs {min(steps)} to {max(steps)} frames apart"
        if min(steps) < max(steps)
        else f"inputs {steps[0]} frames apart"
    )


def resolve(case: Case, scene: CapturedScene) -> dict[str, list[Frame]]:
    """The scene's frames of each group: by the file name in the path, or by number where there is no path.

    A dataset's folders are renamed and reordered by its users, so the rest of the path does not count.
    Raises QuerySplatError when a frame is not on disk, or the scene cannot be read.
    """
    if scene.fault:
        raise QuerySplatError(scene.fault, "Download the scene again, or leave the case out.")
    by_name = {frame.name: frame for frame in scene.frames}
    by_index = {frame.index: frame for frame in scene.frames}
    found: dict[str, list[Frame]] = {}
    for group, refs in case.groups.items():
        frames = [_named(ref.path, by_name) if ref.path else by_index.get(ref.frame_index) for ref in refs]
        missing = [ref for ref, frame in zip(refs, frames, strict=True) if frame is None]
        if missing:
            raise QuerySplatError(
                f"{case.scene}: {missing[0].path or f'frame {missing[0].frame_index}'} is not there"
                + (f", nor {len(missing) - 1} more" if missing[1:] else ""),
                "Download the scene again, or leave the case out.",
            )
        found[group] = [frame for frame in frames if frame is not None]
    return found


def _named(path: str, frames: Mapping[str, Frame]) -> Frame | None:
    """The frame whose name the path ends in; names have folders only where they are needed."""
    parts = PurePosixPath(path).parts
    tails = ("/".join(parts[-count:]) for count in range(1, len(parts) + 1))
    return next((frames[tail] for tail in tails if tail in frames), None)


def _read_release(name: str, content: Mapping[str, Any]) -> Split:
    cases = []
    for number, sample in enumerate(content["samples"]):
        groups = {
            group: tuple(FrameRef(_safe(view["path"]), int(view["frame_index"])) for view in sample[f"{group}_views"])
            for group in GROUPS
        }
        scene = str(sample["scene_id"])
        cases.append(Case(f"{_plain(scene)}_{number:03d}", scene, groups))
    return Split(
        name, str(content["dataset_path"]), int(content["num_input_views"]), str(content.get("scale", "")), tuple(cases)
    )


def _read_index(name: str, content: Mapping[str, Any]) -> list[Split]:
    by_views: dict[int, list[Case]] = {}
    for scene, entry in content.items():
        if entry is None:  # DepthSplat writes null for scenes that it leaves out
            continue
        context, target = sorted(map(int, entry["context"])), sorted(map(int, entry["target"]))
        inner = [i for i in target if context[0] < i < context[-1] and i not in context]
        outer = [i for i in target if not context[0] <= i <= context[-1]]
        positions = {"input": context, "interp": inner, "extrap": outer}
        groups = {group: tuple(FrameRef("", i) for i in chosen) for group, chosen in positions.items()}
        by_views.setdefault(len(context), []).append(Case(_plain(scene), scene, groups))
    if not by_views:
        raise ValueError("it has no scene")
    single = len(by_views) == 1
    return [
        Split(name if single else f"{name}_{views}views", "", views, "", tuple(cases))
        for views, cases in sorted(by_views.items())
    ]


def _safe(path: str) -> str:
    parts = PurePosixPath(path.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or ":" in path:
        raise ValueError(f"the path {path} leaves the dataset")
    return path


def _plain(scene: str) -> str:
    """A scene's name as a folder's name."""
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in scene)
    if not plain.strip("."):
        raise ValueError(f"{scene!r} is no name of a scene")
    return plain
