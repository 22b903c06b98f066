"""The loop of test-time optimisation: whatever the variables are, never worse than before.

However many views there are, variables become Gaussians once a step: the gradients that the views send to
the Gaussians are summed, chunk by chunk, and go back together.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from querysplat_cli.prune.gaussians import Pruned
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.cameras import RefinedCameras
from querysplat_cli.tto.coverage_loss import CoverageLoss
from querysplat_cli.tto.options import Callbacks, TtoSettings, TtoStep
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss, tensors

V = TypeVar("V", bound="Variables")


@runtime_checkable
class Variables(Protocol):
    """A dataclass of tensors."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def map(self: V, change: Callable[[Tensor], Tensor]) -> V: ...


@dataclass(frozen=True)
class Denser(Generic[V]):
    """Variables of more Gaussians, what decodes them, and for each of their rows the one that it was made of. Two rows
    name one that was split."""

    variables: V
    decode: Callable[[V], Gaussians]
    origin: Int[Tensor, "n"]


Densifying = Callable[[Gaussians, RenderingLoss, int], Denser[V]]
"""What splits Gaussians, given how many times it will be asked, this time included."""


@dataclass(frozen=True)
class Parametrisation(Generic[V]):
    """What the optimiser changes, and what becomes of it.

    variables: the tensors that it changes.
    decode: makes Gaussians of them.
    rates: of each variable, by its name, relative to the learning rate.
    densify: splits Gaussians at `TtoPolicy.densify_after`; None splits none.
    """

    variables: V
    decode: Callable[[V], Gaussians]
    rates: Mapping[str, float]
    densify: Densifying[V] | None = None


@dataclass(frozen=True)
class TtoResult(Generic[V]):
    """The better of the first and the last state, by the loss over all views; steps undone on the way.

    `gaussians` is what the variables decode to, less what was `pruned`; `cameras` are those of the input views, which
    were `cameras_before`. `interrupted` says that Ctrl-C ended the run early, `added` how many more Gaussians splitting
    made.
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
    callbacks: Callbacks | None = None,
    refine_cameras: bool = False,
) -> TtoResult[V]:
    """Adam (β 0.9, 0.999) on every tensor of the variables, at `settings.lr` times the tensor's own rate.

    A step after which the loss rises beyond its noise, or anything stops being finite, is undone and the rate halved.
    Pruning decides which Gaussians the rest of the run goes on with. `refine_cameras` corrects the cameras, too.
    Ctrl-C ends the run, which keeps what was reached. Splitting takes the place of a step. It cannot go with pruning,
    which marks rows of the Gaussians that there were at the start.
    """
    progress, pruning = (callbacks or Callbacks()).progress, (callbacks or Callbacks()).prune
    variables, decode, rates, densifying = start.variables, start.decode, start.rates, start.densify
    assert not (pruning and densifying)
    everything = list(range(len(target.views)))
    with torch.no_grad():
        first = decode(variables)
    losses = target.values(first, everything)
    loss = sum(losses) / len(losses)
    before = TtoResult(variables, first, loss, loss, (), target.cameras, target.cameras)
    if not settings.steps:
        return before
    refined = RefinedCameras(target.cameras, first) if refine_cameras else None
    coverage_loss = CoverageLoss.of(first, target.cameras) if settings.keep_cover else None
    run = _Run(variables, decode, settings.lr, rates, refined)
    history: list[TtoStep] = []
    began, undone, in_a_row, interrupted = time.perf_counter(), 0, 0, False
    pruned: Pruned | None = None
    waiting = TTO_POLICY.densify_after if densifying else ()
    draws = _draws(len(everything), settings.views_per_step, generator)
    try:
        for step, chosen in enumerate(islice(draws, settings.steps)):
            done = _done(step, time.perf_counter() - began, settings)
            if done >= 1:
                break
            gaussians = _staying(run.decode(run.variables), pruned)
            target = run.with_refined_cameras(target)
            if pruning and not pruned and done >= TTO_POLICY.prune_after and _finite(tensors(gaussians)):
                pruned = pruning(gaussians.detach(), target, step * (1 - done) / done)
                gaussians = _staying(gaussians, pruned)
                losses = [math.inf] * len(losses)
            here = target.value_and_gradient(gaussians, chosen) if _finite(tensors(gaussians)) else None
            if here:
                here = coverage_loss.add_to(here, gaussians, step) if coverage_loss else here
                here.send_back(gaussians, target.cameras)
            if here is None or not run.finite_gradient() or _risen(here.losses, losses, chosen):
                undone, in_a_row = undone + 1, in_a_row + 1
                run.undo()
                if in_a_row == TTO_POLICY.patience:
                    break
                continue
            in_a_row = 0
            for view, loss in zip(chosen, here.losses, strict=True):
                losses[view] = min(losses[view], loss)
            seconds = time.perf_counter() - began
            history.append(TtoStep(step, here.loss, here.psnr, seconds, len(gaussians)))
            progress(history[-1])
            if densifying and waiting and done >= waiting[0]:
                run.go_on(densifying(gaussians.detach(), target, len(waiting)))
                waiting = waiting[1:]
                losses = [math.inf] * len(losses)
                continue
            run.step(_fall(step, done, settings))
    except KeyboardInterrupt:
        interrupted = True
    found = replace(before, history=tuple(history), undone=undone, interrupted=interrupted)
    last = run.variables.map(Tensor.detach)
    with torch.no_grad():
        gaussians = _staying(run.decode(last), pruned)
        target = run.with_refined_cameras(target)
    loss = target.value(gaussians, everything) if _finite(tensors(gaussians)) else math.inf
    if loss < before.loss_before:
        return replace(
            found,
            variables=last,
            gaussians=gaussians,
            loss_after=loss,
            cameras=target.cameras,
            pruned=pruned,
            added=len(gaussians) - len(first) if densifying else 0,
        )
    return found


def _staying(gaussians: Gaussians, pruned: Pruned | None) -> Gaussians:
    return gaussians if pruned is None else gaussians[pruned.kept]


class _Run(Generic[V]):
    """Variables under Adam, cameras where these are refined, and the way back over the last step."""

    def __init__(
        self,
        variables: V,
        decode: Callable[[V], Gaussians],
        lr: float,
        rates: Mapping[str, float],
        refined: RefinedCameras | None,
    ) -> None:
        self._lr, self._rates, self._refined = lr, rates, refined
        self._start(variables, decode)

    def with_refined_cameras(self, target: RenderingLoss) -> RenderingLoss:
        """The target as the cameras are now."""
        return replace(target, cameras=self._refined.current()) if self._refined else target

    def _start(self, variables: V, decode: Callable[[V], Gaussians]) -> None:
        leaves = variables.map(lambda tensor: tensor.detach().clone().requires_grad_())
        self.variables, self.decode = leaves, decode  # at once, wherever Ctrl-C comes
        self._before = variables.map(lambda tensor: tensor.detach().clone())
        named = {field.name: getattr(self.variables, field.name) for field in fields(self.variables)}
        groups = [{"params": [tensor], "rate": self._rates[name]} for name, tensor in named.items()]
        self._adam = torch.optim.Adam(groups, lr=self._lr, fused=True)

    def finite_gradient(self) -> bool:
        return _finite([tensor.grad for tensor in tensors(self.variables) if tensor.grad is not None])

    def step(self, share: float) -> None:
        """One step at `share` of the rate."""
        for before, now in zip(tensors(self._before), tensors(self.variables), strict=True):
            before.copy_(now.detach())
        for group in self._adam.param_groups:
            group["lr"] = self._lr * group["rate"] * share
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        if self._refined:
            self._refined.step(share)

    def go_on(self, denser: Denser[V]) -> None:
        """With more rows. Each keeps what Adam knows of the one it was made of, unless that one was split."""
        known = [self._adam.state[tensor] for tensor in tensors(self.variables)]
        self._start(denser.variables, denser.decode)
        origin = denser.origin
        split = origin.bincount()[origin] > 1
        for tensor, state in zip(tensors(self.variables), known, strict=True):
            self._adam.state[tensor] = {name: part[origin] if part.dim() else part for name, part in state.items()}
            if state:
                self._adam.state[tensor]["exp_avg"][split] = 0
                self._adam.state[tensor]["exp_avg_sq"][split] = 0

    def undo(self) -> None:
        """Back before the last step, at half the rate and without momentum."""
        if self._refined:
            self._refined.undo()
        self._lr /= 2
        self._start(self._before, self.decode)


def _risen(now: list[float], least: list[float], chosen: list[int]) -> bool:
    mean = sum(least[view] for view in chosen) / len(chosen)
    return not sum(now) / len(now) <= TTO_POLICY.rise * mean + 1e-4


def _done(step: int, seconds: float, settings: TtoSettings) -> float:
    """The part of a run that is over: of its steps, or of its time, with the step that it would take."""
    in_time = 0.0 if settings.seconds is None else seconds * (1 + 1 / max(step, 1)) / max(settings.seconds, 1e-9)
    return max(step / settings.steps, in_time if step else 0.0)


def _fall(step: int, done: float, settings: TtoSettings) -> float:
    cosine = 0.55 + 0.45 * math.cos(math.pi * done)
    return cosine * min(1.0, (step + 1) / max(1, settings.warm_up))


def _finite(some: list[Tensor]) -> bool:
    return all(bool(tensor.detach().isfinite().all()) for tensor in some)


def _draws(views: int, at_once: int | None, generator: torch.Generator) -> Iterator[list[int]]:
    """Endless sets of views, each view once before any comes again."""
    waiting: list[int] = []
    while True:
        if at_once is None or at_once >= views:
            yield list(range(views))
            continue
        if len(waiting) < at_once:
            waiting += torch.randperm(views, generator=generator).tolist()
        yield [waiting.pop(0) for _ in range(at_once)]
