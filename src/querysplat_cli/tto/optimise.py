"""The loop of test-time optimisation. Its result is never worse than its start, whatever the variables are.

However many views there are, variables become Gaussians once a step: the gradients that the views send to the
Gaussians are summed, view by view, and go back to the variables together.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic

import torch

from querysplat_cli.prune.gaussians import Pruned
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.cameras import RefinedCameras
from querysplat_cli.tto.coverage_loss import CoverageLoss
from querysplat_cli.tto.dropout import without_some
from querysplat_cli.tto.options import NO_CALLBACKS, Callbacks, TtoSettings, TtoStep
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import LossAndGradient, RenderingLoss
from querysplat_cli.tto.undoable_adam import UndoableAdam
from querysplat_cli.tto.variables import Parametrisation, UndoableVariables, V, finite


@dataclass(frozen=True)
class TtoResult(Generic[V]):
    """The better of the first and the last state, by the loss over all views.

    variables, gaussians: what the variables are, and what they decode to, less what was `pruned`.
    loss_before, loss_after: over all views.
    history: every step that was not undone.
    cameras_before, cameras: of the input views.
    undone: how many steps were undone.
    interrupted: Ctrl-C ended the run early.
    added: how many Gaussians splitting added.
    """

    variables: V
    gaussians: Gaussians
    loss_before: float
    loss_after: float
    history: tuple[TtoStep, ...]
    cameras_before: Cameras
    cameras: Cameras
    undone: int = 0
    interrupted: bool = False
    pruned: Pruned | None = None
    added: int = 0


def optimise(
    start: Parametrisation[V],
    target: RenderingLoss,
    settings: TtoSettings,
    *,
    generator: torch.Generator,
    callbacks: Callbacks = NO_CALLBACKS,
    refine_cameras: bool = False,
) -> TtoResult[V]:
    """Adam (β 0.9, 0.999) on every tensor of the variables, at `settings.lr` times the tensor's own rate.

    A step after which the loss rises beyond its noise, or anything stops being finite, is undone and the rate halved.
    Where the same views then show the harm of an earlier step, the run goes back to before they were last seen well.
    Pruning decides which Gaussians the rest of the run goes on with. `refine_cameras` corrects the cameras, too.
    Exposures of the target follow, but not to a step that is undone, and go back to where they were unless the scene
    becomes better. Ctrl-C ends the run, which keeps what was reached; before the first step, the losses are those of
    one view. Splitting takes the place of a step. It cannot go with pruning, which marks rows of the Gaussians that
    there were at the start.
    """
    assert not (callbacks.prune and start.densify)
    views = list(range(len(target.views)))
    with torch.no_grad():
        first = start.decode(start.variables)
    interrupted, coverage = False, None
    try:
        losses = target.values(first, views)
        if settings.steps and settings.keep_cover:
            coverage = CoverageLoss.of(first, target.cameras)
    except KeyboardInterrupt:
        losses, interrupted = target.values(first, views[:1]), True
    loss = sum(losses) / len(losses)
    before = TtoResult(start.variables, first, loss, loss, (), target.cameras, target.cameras, interrupted=interrupted)
    if interrupted or not settings.steps:
        return before
    refined = RefinedCameras(target.cameras, first) if refine_cameras else None
    run = _Run(start, settings, callbacks, target, losses, refined, coverage, generator)
    try:
        run.take_steps(_draws(len(views), settings.views_per_step, generator))
    except KeyboardInterrupt:
        interrupted = True
    return run.result(replace(before, history=tuple(run.history), undone=run.undone, interrupted=interrupted))


class _Run(Generic[V]):
    """The state of a run between its steps."""

    def __init__(
        self,
        start: Parametrisation[V],
        settings: TtoSettings,
        callbacks: Callbacks,
        target: RenderingLoss,
        losses: list[float],
        refined: RefinedCameras | None,
        coverage: CoverageLoss | None,
        generator: torch.Generator,
    ) -> None:
        self.history: list[TtoStep] = []
        self.undone = 0
        self._adam = UndoableVariables(start, settings.lr)
        self._settings, self._callbacks, self._densify = settings, callbacks, start.densify
        self._target, self._refined, self._coverage = target, refined, coverage
        self._generator = generator
        self._exposures_before = target.exposures and target.exposures.copy()
        self._least_losses = losses
        self._pruned: Pruned | None = None
        self._prices: torch.Tensor | None = None
        self._splits_left = settings.densify_after if start.densify else ()
        self._undone_in_a_row = 0
        self._again: list[int] = []
        self._began = time.perf_counter()

    @property
    def _steppers(self) -> list[UndoableAdam]:
        """The scene, and its cameras where they are refined."""
        return [self._adam, self._refined] if self._refined else [self._adam]

    def take_steps(self, draws: Iterator[list[int]]) -> None:
        draws = self._marking(draws)
        for step in range(self._settings.steps):
            done = _done(step, time.perf_counter() - self._began, self._settings)
            if done >= 1:
                break
            self._take(step, self._again or next(draws), done)
            if self._undone_in_a_row == TTO_POLICY.patience:
                break

    def _marking(self, draws: Iterator[list[int]]) -> Iterator[list[int]]:
        """`draws`, with marks between them, and so none between a harm and the second look at its views."""
        apart = _draws_between_marks(len(self._target.views), self._settings.views_per_step)
        for number, chosen in enumerate(draws):
            if number % apart == 0:
                for each in self._steppers:
                    each.mark()
            yield chosen

    def result(self, found: TtoResult[V]) -> TtoResult[V]:
        """`found`, which is the start, with the last state if that is better. One Ctrl-C does not break this off."""
        variables = self._adam.variables()
        with torch.no_grad():
            gaussians = self._decoded().detach()
        loss, views = math.inf, list(range(len(self._target.views)))
        if finite(gaussians.tensors()):
            try:
                loss = self._target.value(gaussians, views)
            except KeyboardInterrupt:
                found = replace(found, interrupted=True)
                loss = self._target.value(gaussians, views)
        if not loss < found.loss_before:
            if self._target.exposures and self._exposures_before:
                self._target.exposures.go_back(self._exposures_before)
            return found
        return replace(
            found,
            variables=variables,
            gaussians=gaussians,
            loss_after=loss,
            cameras=self._target.cameras,
            pruned=self._pruned,
            added=len(gaussians) - len(found.gaussians) if self._densify else 0,
        )

    def _take(self, step: int, chosen: list[int], done: float) -> None:
        gaussians = self._pruned_in_time(self._decoded(), step, done)
        share = self._settings.dropout * done
        shown = without_some(gaussians, share, self._generator) if share else gaussians
        exposures = self._target.exposures
        before = exposures and exposures.copy()
        loss = self._send_back(shown, chosen, step)
        if loss is None or not self._adam.gradient_is_finite() or self._has_risen(loss, chosen):
            self._undo(chosen)
            if exposures and before:
                exposures.go_back(before)
            return
        self._note(loss, chosen, step, gaussians)
        if self._splits_left and done >= self._splits_left[0]:
            self._splits_left = tuple(share for share in self._splits_left if share > done)
            self._split(gaussians)
            return
        rate = _rate_share(step, done, self._settings)
        for each in self._steppers:
            each.step(rate)

    def _decoded(self) -> Gaussians:
        """The Gaussians that stay, for a target whose cameras are the refined ones."""
        gaussians = self._adam.gaussians()
        if self._refined:
            self._target = replace(self._target, cameras=self._refined.current())
        return gaussians if self._pruned is None else gaussians[self._pruned.kept]

    def _pruned_in_time(self, gaussians: Gaussians, step: int, done: float) -> Gaussians:
        prune = self._callbacks.prune
        if not prune or self._pruned or done < TTO_POLICY.prune_after or not finite(gaussians.tensors()):
            return gaussians
        self._pruned = prune(gaussians.detach(), self._target, step * (1 - done) / done)
        self._forget_losses()
        return gaussians[self._pruned.kept]

    def _send_back(self, gaussians: Gaussians, chosen: list[int], step: int) -> LossAndGradient | None:
        """The loss, whose gradient is sent to the variables; None where the Gaussians are not finite."""
        if not finite(gaussians.tensors()):
            return None
        loss = self._target.value_and_gradient(gaussians, chosen)
        if self._coverage:
            loss = self._coverage.add_to(loss, gaussians, step)
        if self._prices is not None:
            loss.gradient.opacities.add_(self._prices)
        loss.send_back(gaussians, self._target.cameras)
        return loss

    def _has_risen(self, loss: LossAndGradient, chosen: list[int]) -> bool:
        least = sum(self._least_losses[view] for view in chosen) / len(chosen)
        # Written so that NaN counts as risen.
        return not loss.loss <= min(TTO_POLICY.rise * least, least + TTO_POLICY.largest_rise) + 1e-4

    def _undo(self, chosen: list[int]) -> None:
        """Take the last step back, and look at the same views again.

        If they have still risen, the harm is older: one view a step shows it only when it comes up. These views were
        seen well after the mark before the last one.
        """
        self.undone += 1
        self._undone_in_a_row += 1
        for each in self._steppers:
            each.go_back() if self._again else each.undo()
        if self._again:
            self._forget_losses()
        self._again = chosen

    def _note(self, loss: LossAndGradient, chosen: list[int], step: int, gaussians: Gaussians) -> None:
        self._undone_in_a_row, self._again = 0, []
        for view, value in zip(chosen, loss.losses, strict=True):
            self._least_losses[view] = min(self._least_losses[view], value)
        seconds = time.perf_counter() - self._began
        self.history.append(TtoStep(step, loss.loss, loss.psnr, seconds, len(gaussians)))
        self._callbacks.progress(self.history[-1])
        self._callbacks.look(gaussians)

    def _split(self, gaussians: Gaussians) -> None:
        assert self._densify
        denser = self._densify(gaussians.detach(), self._target, 1 + len(self._splits_left))
        self._adam.go_on_with(denser)
        self._prices = denser.prices
        if self._refined:
            self._refined.keep()
        self._forget_losses()

    def _forget_losses(self) -> None:
        """Losses of other Gaussians are no measure for a rise."""
        self._least_losses = [math.inf] * len(self._least_losses)


def _done(step: int, seconds: float, settings: TtoSettings) -> float:
    """The part of a run that is over: of its steps, or of its time, with the step that it would take."""
    in_time = 0.0 if settings.seconds is None else seconds * (1 + 1 / max(step, 1)) / max(settings.seconds, 1e-9)
    return max(step / settings.steps, in_time if step else 0.0)


def _rate_share(step: int, done: float, settings: TtoSettings) -> float:
    cosine = 0.55 + 0.45 * math.cos(math.pi * done)
    return cosine * min(1.0, (step + 1) / max(1, settings.warm_up))


def _draws_between_marks(views: int, at_once: int | None) -> int:
    """So many of `_draws` that every view is in one of them, from each mark to the next.

    Where sets have views of two rounds, up to 2·(views − 1) others come between two looks at a view.
    """
    at_once = min(at_once or views, views)
    return math.ceil((views if views % at_once == 0 else 2 * views - 1) / at_once)


def _draws(views: int, at_once: int | None, generator: torch.Generator) -> Iterator[list[int]]:
    """Endless sets of views, each view once before any comes again."""
    waiting: list[int] = []
    while True:
        if at_once is None or at_once >= views:
            yield list(range(views))
            continue
        if len(waiting) < at_once:
            again = torch.randperm(views, generator=generator).tolist()
            waiting += sorted(again, key=waiting.__contains__)  # no set has a view twice
        yield [waiting.pop(0) for _ in range(at_once)]
