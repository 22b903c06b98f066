"""The plan of an optimisation: in which spaces, for how many steps, and with how many views a step."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from querysplat_cli.runtime.choices import Space
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY


@dataclass(frozen=True)
class TtoRun:
    """One run of the optimiser in one space."""

    space: Literal["features", "gaussians"]
    settings: TtoSettings


def plan_tto(
    steps: int | None,
    *,
    views: int,
    gaussians: int,
    target_count: int | None = None,
    space: Space = "features",
    resumed: Collection[str] = (),
    seconds: float | None = None,
) -> tuple[TtoRun, ...]:
    """Runs for a scene of so many views and Gaussians, of which pruning leaves `target_count`.

    They take `steps` steps together, or an automatic number (None), and with `seconds` no longer than that. Runs in the
    spaces of `resumed`, which an earlier run optimised, have a lower rate that rises first.
    """
    if steps is None:
        steps = automatic_steps(views, gaussians, target_count, space)
    settings = TtoSettings(
        steps=steps,
        lr=TTO_POLICY.learning_rate,
        views_per_step=TTO_POLICY.views_per_step if views > TTO_POLICY.views_per_step else None,
        seconds=seconds,
        keep_cover=1 < views <= TTO_POLICY.few_views,
        dropout=TTO_POLICY.dropout if 1 < views <= TTO_POLICY.few_views else 0.0,
    )
    return tuple(_resumed(run) if run.space in resumed else run for run in _runs(space, settings))


def plan_release(steps: int, *, space: Space = "features", seconds: float | None = None) -> tuple[TtoRun, ...]:
    """Runs as in the authors' release: every step renders every view."""
    return _runs(space, TtoSettings(steps, TTO_POLICY.release_learning_rate, seconds=seconds))


def with_learning_rate(plan: Sequence[TtoRun], lr: float | None) -> tuple[TtoRun, ...]:
    """The same runs at another learning rate; None leaves each its own."""
    return tuple(run if lr is None else replace(run, settings=replace(run.settings, lr=lr)) for run in plan)


def automatic_steps(
    views: int,
    gaussians: int,
    target_count: int | None,
    space: Space,
    *,
    seconds: float = TTO_POLICY.work_seconds,
    alone: bool = False,
) -> int:
    """The steps that fit into the planned time; more for many views where the run is `alone`, with nothing after it."""
    policy = TTO_POLICY
    share = max(1.0, views / policy.many_views) if alone else 1.0
    splatted: float = gaussians
    if target_count is not None:
        splatted = policy.prune_after * gaussians + (1 - policy.prune_after) * target_count
    cost = policy.splatting_seconds[0] + policy.splatting_seconds[1] * splatted
    if space != "gaussians":
        cost += policy.decoding_seconds[0] + policy.decoding_seconds[1] * gaussians
    steps = min(max(int(share * seconds / cost), policy.fewest_steps), int(share * policy.most_steps))
    if views <= policy.few_views:
        steps = min(steps, policy.passes * views // min(views, policy.views_per_step))
    return steps


def _resumed(run: TtoRun) -> TtoRun:
    slower = replace(run.settings, lr=TTO_POLICY.resumed_learning_rate, warm_up=TTO_POLICY.resumed_warm_up)
    return replace(run, settings=slower)


def _runs(space: Space, settings: TtoSettings) -> tuple[TtoRun, ...]:
    if space != "both":
        return (TtoRun(space, settings),)
    half = replace(settings, seconds=settings.seconds and settings.seconds / 2)
    first = replace(half, steps=settings.steps - settings.steps // 2)
    return TtoRun("features", first), TtoRun("gaussians", replace(half, steps=settings.steps // 2))
