"""What test-time optimisation is asked for: by the user, for one run, and by whoever watches it."""

from collections.abc import Callable
from dataclasses import dataclass

from querysplat_cli.prune.gaussians import Pruned
from querysplat_cli.runtime.choices import Amount, Space
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.lpips import Perceptual
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class OptimiseOptions:
    """What a user asks of test-time optimisation.

    steps: of all runs together; None takes an automatic number.
    lr: the learning rate; None takes the plan's.
    space: what is optimised; None continues in the space of the last run, and starts with features.
    prune: how many Gaussians stay.
    densify_to: Gaussians are split until there are so many; only runs in Gaussian space split.
    refine_cameras: whether the input cameras are corrected, too.
    keep_all: whether Gaussians and SH bands stay even where they change nothing.
    seed: of the order in which views are drawn.
    finest_size: longer side of the pictures, in pixels, that bound how thin a Gaussian may become; None takes the views
        themselves. A scene that was optimised on larger photos keeps their detail so.
    perceptual: LPIPS as a part of the loss; None leaves it out.
    smooth: whether decoded Gaussians are smoothed without any step, too, because earlier steps smoothed them.
    alone: whether no run on the photos themselves follows, so that an automatic number of steps has to be enough.
    """

    steps: int | None = None
    lr: float | None = None
    space: Space | None = None
    prune: Amount = "off"
    densify_to: int | None = None
    refine_cameras: bool = False
    keep_all: bool = False
    seed: int = 42
    finest_size: int | None = None
    perceptual: Perceptual | None = None
    smooth: bool = False
    alone: bool = False


@dataclass(frozen=True)
class TtoSettings:
    """One run of the optimiser.

    steps: at most so many.
    lr: the learning rate. It rises over `warm_up` steps and falls to a tenth along a cosine.
    views_per_step: views drawn for each step, each view once before any comes again; None takes every view in every
        step, as the authors' release does.
    seconds: the run ends when they are over, and the rate falls with the time; None sets no limit.
    keep_cover: whether what the scene covers between the views must stay covered.
    dropout: share of the Gaussians that is left out of a step at the end of the run; it rises from 0 along the way.
    densify_after: shares of the steps after which Gaussians are split, where they are.
    """

    steps: int
    lr: float
    views_per_step: int | None = None
    warm_up: int = 0
    seconds: float | None = None
    keep_cover: bool = False
    dropout: float = 0.0
    densify_after: tuple[float, ...] = TTO_POLICY.densify_after


@dataclass(frozen=True)
class TtoStep:
    """The state before a step: loss and PSNR (dB) on the views of that step, and the seconds since the start."""

    step: int
    loss: float
    psnr: float
    seconds: float
    gaussians: int


Pruning = Callable[[Gaussians, RenderingLoss, float], Pruned]
"""Chooses the Gaussians that stay, by their renders in the target's views and by the number of steps to come."""


Look = Callable[[Gaussians], None]
"""Shows a scene while it is optimised."""


@dataclass(frozen=True)
class Callbacks:
    """What a run calls: `progress` and `look` after every step that is kept, `prune` once.

    `look` gets the Gaussians of the step. `prune` is called after `TtoPolicy.prune_after`.
    """

    progress: Callable[[TtoStep], None] = lambda step: None
    prune: Pruning | None = None
    look: Look = lambda gaussians: None


NO_CALLBACKS = Callbacks()
