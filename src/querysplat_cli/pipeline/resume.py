"""A stored scene is read, optimised further, and written back."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch

from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.full_size import full_size_quality, stored_photos, take_to_full_size
from querysplat_cli.pipeline.gaussian_files import check_target, file_of_scene, folder_of_scene
from querysplat_cli.pipeline.optimise import optimise_start
from querysplat_cli.pipeline.perceptual import optimisation_lpips
from querysplat_cli.pipeline.read_scene import check_model, read_scene, require_scene
from querysplat_cli.pipeline.resume_settings import COARSE, ResumeSettings, against_quality
from querysplat_cli.pipeline.scene_folder import StoredScene, scores_of, write_scene
from querysplat_cli.pipeline.stored_gaussians import before_new_backdrop, stored_gaussians
from querysplat_cli.prune.gaussians import target_count
from querysplat_cli.reporting import omissions
from querysplat_cli.reporting.report import Report, machine, rescored, seconds_entry, tto_entries
from querysplat_cli.reporting.unseen import unseen
from querysplat_cli.runtime.choices import FullSizeLevel, Space
from querysplat_cli.runtime.device import find_device, peak_gib
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import check_precision
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.drafts import claimed
from querysplat_cli.scene.files import check_writable, with_name, without_steps
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.cameras import with_refined_focal
from querysplat_cli.tto.features import Start
from querysplat_cli.tto.full_size_plan import plan_full_size
from querysplat_cli.tto.options import OptimiseOptions
from querysplat_cli.tto.plan import TtoRun, plan_release, plan_tto, with_learning_rate
from querysplat_cli.tto.policy import TTO_POLICY


def optimise_scene(settings: ResumeSettings, stages: Stages | None = None) -> Report:
    """Optimise the scene in `settings.scene` (its folder, or the Gaussians beside it) further, and write it back.

    Raises QuerySplatError when the scene is damaged, when feature space is asked for although the Gaussians were
    optimised themselves, when `densify` asks for splitting in feature space or for fewer Gaussians than there are, and
    when `quality` comes with options that it decides, or needs photos that are gone. So it is with a kind of file that
    is not written here.
    """
    folder = require_scene(with_name(settings.scene)).parent
    path = with_name(settings.scene)
    beside = file_of_scene(path)
    if folder.is_symlink() and (beside.is_symlink() or not beside.is_file()):
        path = folder.resolve()  # the scene is elsewhere, and not the folder alone
    check_target(file_of_scene(path))
    settings = replace(settings, scene=path)
    conflict = against_quality(settings)
    if settings.quality and conflict:
        raise conflict
    check_writable(path.parent)
    with claimed(without_steps(folder)):
        return _optimised(settings, stages or Stages())


def _optimised(settings: ResumeSettings, stages: Stages) -> Report:
    path, options = settings.scene, _options(settings)
    with stages("read"):
        scene, before = _read(settings)
    level = settings.quality or (None if against_quality(settings) else _level_again(scene, before))
    if level:
        return _at_full_size(settings, level, scene, before, stages)
    with stages("read"):
        model = load_again(scene, before["settings"], settings.weights, find_device(settings.device))
        spaces = [run["space"] for run in before["tto"] if run["steps"]]
        space = options.space or (spaces[-1] if spaces else "features")
        apart = "gaussians" in spaces
        count = before["gaussians"] - scene.backdrop
        if scene.joined and space != "gaussians":
            raise joined_of_regions(path, "Use --space gaussians, or make the scene again with --regions 1.")
        _check(path, options, space, count, apart=apart)
        beside = stored_gaussians(path, scene, before) if apart or file_of_scene(path).is_file() else None
        gaussians = beside.own if beside and apart else None
    with stages("tto") as progress:
        perceptual = optimisation_lpips(settings.lpips, official=scene.anchors is None)
        options = replace(
            options,
            perceptual=perceptual,
            finest_size=_finest_size(scene, before),
            smooth=bool(spaces) and "backdrop" in before,  # scenes of earlier versions were not smoothed
        )
        plan = _plan(scene, count, options, space, resumed=spaces)
        stays = beside if _changes_nothing(plan, options) else None
        options = replace(options, keep_all=stays is not None)
        start = Start(scene.memories, scene.anchors, gaussians, None if apart else scene.kept)
        photos = scene.views, scene.cameras
        adapted = optimise_start(model, start, photos, plan, options, progress, scene.exposures)
        if stays:
            stored, gaussians = scene, stays.all
        else:
            stored, gaussians = before_new_backdrop(_with(scene, adapted), adapted.gaussians)
    runs = tto_entries(adapted.runs)
    bands_stay, with_lpips = stays is not None, perceptual is not None
    left_out = omissions.taken_further(before["left_out"], adapted, bands_stay=bands_stay, with_lpips=with_lpips)
    stepped = any(run["steps"] for run in runs)
    coarse = [COARSE] if options.finest_size and (stepped or COARSE in before["warnings"]) else []
    return _write_back(path, stored, gaussians, before, stages, tto=runs, left_out=left_out, warnings=coarse)


def joined_of_regions(path: Path, hint: str) -> QuerySplatError:
    """The error where a scene needs queries, and has none because it was joined from regions."""
    return QuerySplatError(f"{path} was joined from regions, and has no queries", hint)


def _level_again(scene: StoredScene, before: dict[str, Any]) -> FullSizeLevel | None:
    """The level that a scene of large photos has: steps on the small pictures would take their detail."""
    level = (before.get("full_size") or {}).get("level")
    return level if _finest_size(scene, before) and level in get_args(FullSizeLevel) else None


def _at_full_size(
    settings: ResumeSettings, level: FullSizeLevel, scene: StoredScene, before: dict[str, Any], stages: Stages
) -> Report:
    """Optimise the Gaussians of the stored scene on its large photos, and write it back."""
    path, device = settings.scene, find_device(settings.device)
    with stages("read"):
        gaussians = stored_gaussians(path, scene, before).own
    inputs, heldout = stored_photos(scene)
    with stages("full size") as progress:
        photos = replace(inputs.summary(), reached=_finest_size(scene, before) or 0)
        plan = plan_full_size(level, photos, len(gaussians))
        found = take_to_full_size(inputs, gaussians, plan, seed=settings.seed, device=device, progress=progress)
    stored, gaussians = before_new_backdrop(replace(scene, exposures=found.exposures), found.gaussians)
    with stages("full size score"):
        quality = full_size_quality(gaussians, found.size, inputs, heldout)
    return _write_back(
        path,
        stored,
        gaussians,
        before,
        stages,
        quality={"full_size": quality},
        tto=found.runs,
        full_size=found.summary,
    )


def _write_back(
    path: Path,
    scene: StoredScene,
    gaussians: Gaussians,
    before: dict[str, Any],
    stages: Stages,
    *,
    tto: list[dict[str, Any]],
    quality: dict[str, Any] | None = None,
    warnings: Collection[str] = (),
    **changes: Any,
) -> Report:
    """Score the scene, and write it with the report `before` brought up to date.

    `tto` are the entries of new runs, `quality` further scores, `warnings` those of these runs, and `changes` other
    fields of the report.
    """
    with stages("score"):
        scores = scores_of(scene, gaussians)
        film = unseen(gaussians, scene.cameras, scene.views.sizes)
    with stages("write"):
        report = replace(
            Report.from_dict(before),
            ply=str(file_of_scene(path)),
            scene=str(folder_of_scene(path)),
            gaussians=len(gaussians),
            seconds=seconds_entry(stages.seconds, stages.elapsed()),
            quality=rescored(scores, before["quality"]) | {"before": _psnr(before["quality"])} | (quality or {}),
            tto=[*before["tto"], *tto],
            peak_memory_gib=round(peak_gib(), 2),
            machine=machine(),
            unseen=film.entry() if film else None,
            backdrop=scene.backdrop,
            resumed=[],
            warnings=[*(each for each in before["warnings"] if each != COARSE), *warnings],
            **changes,
        )
        entries = report.as_dict()
        write_scene(file_of_scene(path), scene, gaussians, entries)
    return Report.from_dict(entries)


def _read(settings: ResumeSettings) -> tuple[StoredScene, dict[str, Any]]:
    """The stored scene, without colour transforms where --exposure is off, and its report."""
    scene, before = read_scene(settings.scene)
    if before["gaussians"] <= scene.backdrop:
        raise QuerySplatError(f"nothing but its backdrop is left of {settings.scene}", "Cut less of the scene.")
    if settings.exposure == "off" and scene.exposures:
        measured = before.get("exposure")
        corrected = {**measured, "corrected": False} if measured else None
        return replace(scene, exposures=None), {**before, "exposure": corrected}
    return scene, before


def _psnr(quality: dict[str, Any]) -> dict[str, float | None]:
    """PSNR in dB on inputs and held-out views, of a stored report; None where it has none."""
    groups = {name: quality.get(name) for name in ("input", "heldout")}
    values = {name: group.get("psnr") if isinstance(group, dict) else None for name, group in groups.items()}
    return {name: float(value) if isinstance(value, int | float) else None for name, value in values.items()}


def _options(settings: ResumeSettings) -> OptimiseOptions:
    return OptimiseOptions(
        steps=settings.steps,
        lr=settings.lr,
        space=settings.space,
        prune=settings.prune,
        densify_to=settings.densify,
        refine_cameras=settings.refine_cameras,
        seed=settings.seed,
    )


def _finest_size(scene: StoredScene, before: dict[str, Any]) -> int | None:
    """The longer side of the large photos that the scene was optimised on; None where it was not."""
    largest = max((run.get("max_size", 0) for run in before["tto"]), default=0)
    return largest if largest > max(scene.cameras.height, scene.cameras.width) else None


def load_again(scene: StoredScene, settings: dict[str, Any], weights: Path | None, device: torch.device) -> QuerySplat:
    """The model of a stored scene, from the settings in its report. Raises QuerySplatError where it fits no more."""
    stored = settings.get("weights")
    folder = weights or (Path(stored) if stored else None)
    model = load(scene.model, folder, precision=check_precision(settings.get("precision", "fp32")), device=device)
    if model.config.queries == "learned" and settings["queries"]:
        model.keep_queries(settings["queries"])
    check_model(scene, model.config)
    return model


def _check(path: Path, options: OptimiseOptions, space: Space, count: int, *, apart: bool) -> None:
    """Refuse what a scene of `count` Gaussians cannot do; `apart` where memories no longer decode to them."""
    if apart and space != "gaussians":
        raise QuerySplatError(
            f"the Gaussians of {path} were optimised themselves, and its memories would undo that",
            "Use --space gaussians, or make the scene again with --quality draft.",
        )
    if options.densify_to is None:
        return
    if space == "features":
        raise QuerySplatError("--densify splits Gaussians, which memories cannot follow", "Use --space gaussians.")
    left = min(count, options.prune) if isinstance(options.prune, int) else count
    if options.prune != "auto" and options.densify_to <= left:
        raise QuerySplatError(
            f"--densify {options.densify_to}: the scene has {left:,} Gaussians already",
            "Ask for more, or use --prune N for fewer.",
        )


def _plan(
    scene: StoredScene, count: int, options: OptimiseOptions, space: Space, *, resumed: Collection[str]
) -> tuple[TtoRun, ...]:
    if scene.anchors is None:
        steps = TTO_POLICY.release_steps if options.steps is None else options.steps
        return with_learning_rate(plan_release(steps, space=space), options.lr)
    plan = plan_tto(
        options.steps,
        views=len(scene.views),
        gaussians=count if space == "gaussians" else scene.anchors.opacities.numel(),
        target_count=target_count(count, options.prune, scene.cameras),
        space=space,
        resumed=resumed,
    )
    return with_learning_rate(plan, options.lr)


def _changes_nothing(plan: Collection[TtoRun], options: OptimiseOptions) -> bool:
    """Whether a plan takes no step, and nothing is pruned ahead of it (see `adapt`)."""
    pruned = isinstance(options.prune, int) or (options.prune == "auto" and options.densify_to is not None)
    return not pruned and not any(run.settings.steps for run in plan)


def _with(scene: StoredScene, adapted: Adapted) -> StoredScene:
    """The scene with what optimisation made of it. Held-out cameras get the refined focal length."""
    heldout = scene.heldout
    if heldout:
        heldout = heldout[0], with_refined_focal(heldout[1], scene.cameras, adapted.cameras)
    return replace(
        scene,
        cameras=adapted.cameras,
        heldout=heldout,
        memories=adapted.memories,
        kept=adapted.kept,
        exposures=adapted.exposures,
    )
