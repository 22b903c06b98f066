"""The plan of an evaluation: splits, rows, and the cases that are not done yet."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation.axes import FIXED
from querysplat_cli.evaluation.case import Row, parts, same_parts
from querysplat_cli.evaluation.generate import generate
from querysplat_cli.evaluation.grid import rows
from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.evaluation.results import RowFolder, checkpoint_sha256, open_row_folder, run_config, write_failure
from querysplat_cli.evaluation.splits import Case, Split, read_splits, resolve
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.formats.dataset import CapturedScene, Frame
from querysplat_cli.splat.lpips import LpipsFiles, find_lpips


@dataclass(frozen=True)
class Job:
    """One case and the rows that have no scores of it yet."""

    split: str
    case: Case
    groups: dict[str, list[Frame]]
    cameras: dict[str, PhotoCamera]
    rows: tuple[Row, ...]

    @property
    def asked(self) -> dict[str, int]:
        """How many views of each group are to be scored."""
        return {group: len(frames) for group, frames in self.groups.items()}


def plan_splits(request: EvalRequest, scenes: Sequence[CapturedScene], say: Callable[[str], None]) -> list[Split]:
    """The given splits, or generated ones. `say` gets the reason for each that cannot be generated."""
    if request.splits:
        splits = [split for path in request.splits for split in read_splits(path)]
        names = [split.name for split in splits]
        if len(set(names)) < len(names):
            raise QuerySplatError("two splits have one name", "Rename a split file.")
        return [replace(split, cases=split.cases[: request.cases]) for split in splits]
    first = request.scenes[0].resolve()
    dataset = first.parent.name if scenes[0].name == first.name.removesuffix(".zip") else first.name
    splits = []
    for views in request.views:
        for scale in request.scales:
            try:
                cases = request.cases or EVALUATION_POLICY.generated_cases
                splits.append(generate(scenes, dataset, views, scale, cases=cases, seed=request.settings.seed))
            except ImpossibleScene as error:
                say(error.message)
                reason = error
    if not splits:
        raise reason
    return splits


def plan_rows(
    request: EvalRequest, scenes: Iterable[CapturedScene], say: Callable[[str], None]
) -> list[tuple[Row, dict[str, Any]]]:
    """The rows, each with the settings that its run_config.json lists.

    Raises MissingPart, before any case is run, when weights or a package are missing.
    """
    if request.predictions:
        if not request.predictions.is_dir():
            raise QuerySplatError(f"{request.predictions}: no such folder", "Give the folder of a method's outputs.")
        name = request.name or request.predictions.resolve().name
        if Path(name).name != name or name == "splits" or name.startswith("."):
            raise QuerySplatError(f"--name {name}: not the name of a folder", "Use letters, digits, - and _.")
        return [(Row(name, "querysplat", "free"), {"predictions": str(request.predictions)})]
    posed = any(scene.cameras for scene in scenes)
    if "posed" in request.cameras and not posed:
        say("no scene has known cameras: the posed rows are left out")
    sources = [source for source in request.cameras if source == "free" or posed]
    table = []
    for row in rows(request.axes, sources):
        settings = replace(request.settings, **dict(row.overrides))
        known = {key: value for key, value in asdict(settings).items() if key not in FIXED - {"seed"}}
        content = {key: value if isinstance(value, int | float | None) else str(value) for key, value in known.items()}
        model, encoder = parts(same_parts(settings))
        content["encoder"] = encoder.name
        if row.method == "depth":
            content = {key: content[key] for key in ("encoder", "max_size", "seed")}
            if model.config.queries == "learned":
                row = replace(row, overrides=(("depth", True),))
        else:
            if model.config.queries == "learned":
                content["lpips"] = isinstance(find_lpips(request.lpips), LpipsFiles)
            content["checkpoint_sha256"] = checkpoint_sha256(settings.preset, settings.weights)
        table.append((row, {"method": row.method, "cameras": row.cameras, **content}))
    parts.cache_clear()  # the workers load their own
    return table


def plan_jobs(
    request: EvalRequest,
    splits: Sequence[Split],
    scenes: dict[str, CapturedScene],
    table: Sequence[tuple[Row, dict[str, Any]]],
    lpips: LpipsFiles | str,
) -> list[Job]:
    """The cases of this shard that are not done in every row."""
    about_lpips = {"net": lpips.net} if isinstance(lpips, LpipsFiles) else {"missing": lpips}
    for split in splits:
        for row, settings in table:
            config = run_config(settings, split, request.protocol, about_lpips) | _further(request)
            open_row_folder(RowFolder(request.out, row.name, split.name), config, force=request.force)
    number, of = request.shard or (1, 1)
    jobs = []
    every = [(split, case) for split in splits for case in split.cases]
    for split, case in every[number - 1 :: of]:
        open_rows = tuple(
            row for row, _ in table if not RowFolder(request.out, row.name, split.name).is_done(case.name)
        )
        if not open_rows:
            continue
        try:
            if case.scene not in scenes:
                raise QuerySplatError(f"{case.scene}: no such scene in {', '.join(map(str, request.scenes))}")
            scene = scenes[case.scene]
            groups = resolve(case, scene)
        except QuerySplatError as error:
            asked = {group: len(refs) for group, refs in case.groups.items()}
            for row in open_rows:
                folder = RowFolder(request.out, row.name, split.name).case(case.name)
                write_failure(folder, case.scene, error.message, asked=asked)
            continue
        wanted = {frame.name for frames in groups.values() for frame in frames}
        cameras = {name: camera for name, camera in scene.cameras.items() if name in wanted}
        jobs.append(Job(split.name, case, groups, cameras, open_rows))
    return jobs


def _further(request: EvalRequest) -> dict[str, Any]:
    """Entries of run_config.json that differ from those of older runs only where their scores do."""
    entries: dict[str, Any] = {}
    if request.protocol == "text":
        entries["renders"] = "at the method's own resolution"
    if request.metrics:
        entries["metrics"] = list(request.metrics)
    if request.fitted:
        entries["fitted"] = True
    if request.pictures != EvalRequest.pictures:
        entries["pictures"] = request.pictures
    return entries
