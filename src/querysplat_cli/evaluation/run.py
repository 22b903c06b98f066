"""`querysplat eval`: the scores of every row on every case of every split."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from traceback import format_exc
from typing import Any

from querysplat_cli.evaluation.case import CaseRunner
from querysplat_cli.evaluation.count import Counter, to_do
from querysplat_cli.evaluation.judge import Judge
from querysplat_cli.evaluation.keeping import Keeping
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.perceptual import check_installed
from querysplat_cli.evaluation.plan import Job, plan_jobs, plan_rows, plan_splits
from querysplat_cli.evaluation.predictions import score_prediction
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.evaluation.results import RowFolder, write_case, write_failure
from querysplat_cli.evaluation.splits import Split, spacing, write_index, write_split
from querysplat_cli.evaluation.summary import summarise
from querysplat_cli.runtime.cluster import find_engine
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, SCENE_KERNELS, start_compiling, wait_until_compiled
from querysplat_cli.runtime.device import find_device
from querysplat_cli.runtime.engine import report_progress
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.runtime.words import counted
from querysplat_cli.runtime.workers import Workers
from querysplat_cli.scene.files import writable
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.splat.lpips import LpipsFiles, find_lpips, load_lpips


@dataclass(frozen=True)
class Setup:
    """What every case of a run has in common."""

    request: EvalRequest
    lpips: LpipsFiles | None


def evaluate(request: EvalRequest, stages: Stages, say: Callable[[str], None]) -> dict[str, Any]:
    """Run the cases that are not done yet, and summarise all results in `request.out`. `say` gets the messages.

    Raises QuerySplatError on bad input. A case that fails is listed in the summary.
    """
    with writable(request.out):
        return _evaluated(request, stages, say)


def _evaluated(request: EvalRequest, stages: Stages, say: Callable[[str], None]) -> dict[str, Any]:
    with stages("splits"):
        scenes = {scene.name: scene for scene in find_scenes(request.scenes, request.pictures)}
        for scene in scenes.values():
            for note in scene.notes:
                say(f"{scene.name}: {note}")
        splits = plan_splits(request, list(scenes.values()), say)
        for split in splits:
            say(f"{split.name}: {counted(len(split.cases), 'case')}, {spacing(split)}")
    if request.splits_only:
        _write_splits(request.out, splits)
        return {"splits": [split.name for split in splits], "out": str(request.out)}
    with stages("model"):
        lpips = find_lpips(request.lpips, request.lpips_net)
        if isinstance(lpips, LpipsFiles):
            load_lpips(lpips)
        else:
            say(lpips)
        for metric in request.metrics:
            check_installed(metric)
        table = plan_rows(request, scenes.values(), say)
    jobs = plan_jobs(request, splits, scenes, table, lpips)
    _write_splits(request.out, splits)
    say(to_do(jobs, len(splits), request.workers))
    keeping = Keeping(request.save_pictures, request.nerfbaselines)
    folders = [RowFolder(request.out, row.name, split.name) for split in splits for row, _ in table]
    if lacking := keeping.lacking(folders):
        say(f"{counted(lacking, 'finished scene')} without the pictures asked for: only --force makes them again")
    setup = Setup(request, lpips if isinstance(lpips, LpipsFiles) else None)
    with stages("cases") as progress:
        counter = Counter(jobs, progress)

        def done(job: Job, died: str | None) -> None:
            if died:
                say(f"{job.split}, {job.case.name}: {died}")
                for row in job.rows:
                    row_folder = RowFolder(request.out, row.name, job.split)
                    if not row_folder.is_done(job.case.name):
                        write_failure(row_folder.case(job.case.name), job.case.scene, died, asked=job.asked)
            counter.done(job)

        if jobs:
            find_engine(request.cluster, Workers(request.workers), say).run(handler, setup, jobs, done, counter.heard)
    with stages("summary"):
        return summarise(request.out)


def handler(setup: Setup) -> Callable[[Job], None]:
    """The function that runs one job in a worker."""
    meter = Meter(load_lpips(setup.lpips) if setup.lpips else None, setup.request.metrics)
    if find_device(setup.request.settings.device).type == "cpu" and not setup.request.predictions:
        start_compiling(*DEPTH_KERNELS, *SCENE_KERNELS)  # otherwise the first case's seconds would include it
        wait_until_compiled(*DEPTH_KERNELS, *SCENE_KERNELS)
    return partial(_work, setup.request, meter)


def _work(request: EvalRequest, meter: Meter, job: Job) -> None:
    keeping = Keeping(request.save_pictures, request.nerfbaselines)
    judge: Judge | None = None
    runner: CaseRunner | None = None
    apart: dict[str, list[str]] = {}
    for number, row in enumerate(job.rows):
        report_progress(row.name, number / len(job.rows))
        folder = RowFolder(request.out, row.name, job.split).case(job.case.name)
        try:
            judge = judge or Judge(job.groups, job.cameras, Protocol(request.protocol), meter, fitted=request.fitted)
            apart = judge.apart
            if request.predictions:
                result = score_prediction(judge, request.predictions, job.split, job.case.name)
            else:
                runner = runner or CaseRunner(judge, request.settings, request.lpips)
                result = runner.run(row)
            about = {"row": row.name, "split": job.split, "case": job.case.name, "protocol": request.protocol}
            write_case(folder, job.case.scene, result, keeping.writer(about, judge.truth, meter))
        except QuerySplatError as error:
            write_failure(folder, job.case.scene, error.message, error.hint, asked=job.asked, apart=apart)
        except Exception as error:
            why = f"a bug: {type(error).__name__}: {error}"
            write_failure(folder, job.case.scene, why, format_exc(), asked=job.asked, apart=apart)


def _write_splits(out: Path, splits: Sequence[Split]) -> None:
    for split in splits:
        write_split(out / "splits" / f"{split.name}.json", split)
        write_index(out / "splits" / f"{split.name}.index.json", split)
