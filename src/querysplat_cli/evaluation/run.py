"""The story of `eval`: scenes and splits in, scores of every row on one scale out."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from traceback import format_exc
from typing import Any

from querysplat_cli.device import find_device
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.evaluation.case import CameraSource, CaseRunner, Row
from querysplat_cli.evaluation.grid import FIXED, Axis, rows
from querysplat_cli.evaluation.lpips import LpipsFiles, find_lpips, load_lpips
from querysplat_cli.evaluation.predictions import score_prediction
from querysplat_cli.evaluation.protocol import RELEASE_SIDE, Protocol
from querysplat_cli.evaluation.results import (
    Place,
    checkpoint_sha256,
    prepare,
    run_config,
    write_case,
    write_failure,
)
from querysplat_cli.evaluation.splits import (
    Case,
    Split,
    generate,
    read_splits,
    resolve,
    spacing,
    write_index,
    write_split,
)
from querysplat_cli.evaluation.summary import summarise
from querysplat_cli.evaluation.workers import Workers
from querysplat_cli.model.checkpoints import load
from querysplat_cli.pipeline import ReconstructSettings
from querysplat_cli.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.files import check_writable
from querysplat_cli.scene.formats.dataset import CapturedScene, Frame, find_scenes

GENERATED_CASES = 300
"""Cases of a generated split, as many as the authors' have."""


@dataclass(frozen=True)
class EvalRequest:
    """What `querysplat eval` can be asked for; see docs/cli.md. `cases` None means all, or 300 of a generated split."""

    scenes: tuple[Path, ...]
    out: Path
    splits: tuple[Path, ...]
    views: tuple[int, ...]
    scales: tuple[str, ...]
    cases: int | None
    protocol: Protocol
    cameras: tuple[CameraSource, ...]
    axes: tuple[Axis, ...]
    settings: ReconstructSettings
    predictions: Path | None
    name: str | None
    lpips: Path | None
    lpips_net: str
    pictures: str
    save_pictures: bool
    shard: tuple[int, int]
    workers: int
    splits_only: bool
    force: bool


@dataclass(frozen=True)
class Setup:
    """What every case of a run has in common."""

    out: Path
    protocol: Protocol
    settings: ReconstructSettings
    lpips: LpipsFiles | None
    save_pictures: bool
    predictions: Path | None


@dataclass(frozen=True)
class Job:
    """One case and the rows that are still to be worked out for it."""

    split: str
    case: Case
    groups: dict[str, list[Frame]]
    cameras: dict[str, PhotoCamera]
    rows: tuple[Row, ...]


def evaluate(request: EvalRequest, stages: Stages, say: Callable[[str], None]) -> dict[str, Any]:
    """Run what is not done yet, and summarise all that `request.out` holds; `say` is told what is worth knowing.

    Raises QuerySplatError on bad input. A case that fails is listed in the summary.
    """
    check_writable(request.out)
    with stages("splits"):
        scenes = {scene.name: scene for scene in find_scenes(request.scenes, request.pictures)}
        for scene in scenes.values():
            for note in scene.notes:
                say(f"{scene.name}: {note}")
        splits = _splits(request, list(scenes.values()), say)
        for split in splits:
            say(f"{split.name}: {len(split.cases)} cases, {spacing(split)}")
    if request.splits_only:
        _write_splits(request.out, splits)
        return {"splits": [split.name for split in splits], "out": str(request.out)}
    with stages("model"):
        lpips = find_lpips(request.lpips, request.lpips_net)
        if isinstance(lpips, LpipsFiles):
            load_lpips(lpips)
        else:
            say(lpips)
        table = _rows(request, scenes.values(), say)
    jobs = _jobs(request, splits, scenes, table, lpips)
    _write_splits(request.out, splits)
    setup = Setup(
        request.out,
        request.protocol,
        request.settings,
        lpips if isinstance(lpips, LpipsFiles) else None,
        request.save_pictures,
        request.predictions,
    )
    with stages("cases") as progress:
        finished = 0

        def done(job: Job, died: str | None) -> None:
            nonlocal finished
            finished += 1
            if died:
                say(f"{job.split}, {job.case.name}: {died}")
                for row in job.rows:
                    place = Place(request.out, row.name, job.split)
                    if not place.is_done(job.case.name):
                        write_failure(place.case(job.case.name), job.case.scene, died)
            progress(f"{finished} of {len(jobs)}: {job.split}, {job.case.name}", finished / len(jobs))

        if jobs:
            Workers(request.workers, handler, setup).run(jobs, done)
    with stages("summary"):
        return summarise(request.out)


def handler(setup: Setup) -> Callable[[Job], None]:
    """What a worker does with each job."""
    lpips = load_lpips(setup.lpips) if setup.lpips else None
    return partial(_work, setup, lpips)


def _work(setup: Setup, lpips: Any, job: Job) -> None:
    runner: CaseRunner | None = None
    for row in job.rows:
        folder = Place(setup.out, row.name, job.split).case(job.case.name)
        try:
            runner = runner or CaseRunner(job.groups, job.cameras, setup.protocol, setup.settings, lpips)
            if setup.predictions:
                result = score_prediction(runner, setup.predictions, job.split, job.case.name)
            else:
                result = runner.run(row)
            write_case(folder, job.case.scene, result, pictures=setup.save_pictures)
        except QuerySplatError as error:
            write_failure(folder, job.case.scene, error.message, error.hint)
        except Exception as error:
            write_failure(folder, job.case.scene, f"a bug: {type(error).__name__}: {error}", format_exc())


def _splits(request: EvalRequest, scenes: Sequence[CapturedScene], say: Callable[[str], None]) -> list[Split]:
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
                cases = request.cases or GENERATED_CASES
                splits.append(generate(scenes, dataset, views, scale, cases=cases, seed=request.settings.seed))
            except ImpossibleScene as error:
                say(error.message)
                reason = error
    if not splits:
        raise reason
    return splits


def _write_splits(out: Path, splits: Sequence[Split]) -> None:
    for split in splits:
        write_split(out / "splits" / f"{split.name}.json", split)
        write_index(out / "splits" / f"{split.name}.index.json", split)


def _rows(
    request: EvalRequest, scenes: Iterable[CapturedScene], say: Callable[[str], None]
) -> list[tuple[Row, dict[str, Any]]]:
    """The rows, and what is to be known of each one's settings. Fails before any work where a part is missing."""
    if request.predictions:
        if not request.predictions.is_dir():
            raise QuerySplatError(f"{request.predictions}: no such folder", "Give the folder of a method's outputs.")
        name = request.name or request.predictions.resolve().name
        return [(Row(name, "querysplat", "free"), {"predictions": str(request.predictions)})]
    find_device(request.settings.device)
    posed = any(scene.cameras for scene in scenes)
    if "posed" in request.cameras and not posed:
        say("no scene has known cameras: the posed rows are left out")
    sources = [source for source in request.cameras if source == "free" or posed]
    table = []
    for row in rows(request.axes, sources):
        settings = replace(request.settings, **dict(row.overrides))
        known = {key: value for key, value in asdict(settings).items() if key not in FIXED - {"seed"}}
        content = {key: value if isinstance(value, int | float | None) else str(value) for key, value in known.items()}
        find_encoder(settings.encoder)
        if row.method == "depth":
            content = {key: content[key] for key in ("encoder", "max_size", "seed")}
        else:
            content["checkpoint_sha256"] = checkpoint_sha256(settings.preset)
        table.append((row, {"method": row.method, "cameras": row.cameras, **content}))
    for preset in {str(content["preset"]) for _, content in table if "preset" in content}:
        load(preset)
    return table


def _jobs(
    request: EvalRequest,
    splits: Sequence[Split],
    scenes: dict[str, CapturedScene],
    table: Sequence[tuple[Row, dict[str, Any]]],
    lpips: LpipsFiles | str,
) -> list[Job]:
    """The cases of this shard that some row has no scores of."""
    about_lpips = {"net": lpips.net} if isinstance(lpips, LpipsFiles) else {"missing": lpips}
    for split in splits:
        for row, settings in table:
            config = run_config(settings, split, request.protocol.name, about_lpips)
            prepare(Place(request.out, row.name, split.name), config, force=request.force)
    number, of = request.shard
    jobs = []
    every = [(split, case) for split in splits for case in split.cases]
    for split, case in every[number - 1 :: of]:
        open_rows = tuple(row for row, _ in table if not Place(request.out, row.name, split.name).is_done(case.name))
        if not open_rows:
            continue
        try:
            if case.scene not in scenes:
                raise QuerySplatError(f"{case.scene}: no such scene in {', '.join(map(str, request.scenes))}")
            scene = scenes[case.scene]
            groups = resolve(case, scene)
        except QuerySplatError as error:
            for row in open_rows:
                write_failure(Place(request.out, row.name, split.name).case(case.name), case.scene, error.message)
            continue
        wanted = {frame.name for frames in groups.values() for frame in frames}
        cameras = {name: camera for name, camera in scene.cameras.items() if name in wanted}
        jobs.append(Job(split.name, case, groups, cameras, open_rows))
    return jobs


def default_size(protocol: Protocol) -> int:
    """The longer side at which a method works unless the user says otherwise: that of the photos it is shown."""
    return RELEASE_SIDE if protocol.name == "release" else 1 << 16
