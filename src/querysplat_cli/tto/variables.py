"""What test-time optimisation changes, and its Adam."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.splat.render import all_finite
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.undoable_adam import UndoableAdam

V = TypeVar("V", bound=TensorDataclass)


@dataclass(frozen=True)
class Denser(Generic[V]):
    """Variables of more Gaussians, and what decodes them.

    `origin` is for each of their rows the row that it was made of. A Gaussian that was split is the origin of two rows,
    one that was left out of none.
    `prices` are added to the slope of the loss by each opacity, until the next split (None: nothing is).
    """

    variables: V
    decode: Callable[[V], Gaussians]
    origin: Int[Tensor, "n"]
    prices: Float[Tensor, "n"] | None = None


Densifying = Callable[[Gaussians, RenderingLoss, int], Denser[V]]
"""Splits Gaussians. The number is how many times it will be called, this time included."""


@dataclass(frozen=True)
class Parametrisation(Generic[V]):
    """What the optimiser changes, and what becomes of it.

    variables: the tensors that it changes.
    decode: makes Gaussians of them.
    rates: of each variable, by its name, relative to the learning rate.
    densify: splits Gaussians at `TtoSettings.densify_after`; None splits none.
    """

    variables: V
    decode: Callable[[V], Gaussians]
    rates: Mapping[str, float]
    densify: Densifying[V] | None = None


class UndoableVariables(UndoableAdam, Generic[V]):
    """Variables under Adam (β 0.9, 0.999)."""

    def __init__(self, start: Parametrisation[V], lr: float) -> None:
        self._rates = start.rates
        self._start(start.variables, start.decode, lr)

    def gaussians(self) -> Gaussians:
        """Decoded from the variables, and differentiable in them."""
        return self._decode(self._variables)

    def variables(self) -> V:
        """The variables as they are, without a gradient."""
        return self._variables.map(Tensor.detach)

    def gradient_is_finite(self) -> bool:
        return finite([leaf.grad for leaf in self._leaves if leaf.grad is not None])

    def go_on_with(self, denser: Denser[V]) -> None:
        """Take other rows. Each inherits the moments of its origin, unless the origin was split."""
        moments = [self._adam.state[leaf] for leaf in self._leaves]
        self._start(denser.variables, denser.decode, self._lr)
        origin = denser.origin
        split = origin.bincount()[origin] > 1
        for leaf, state in zip(self._leaves, moments, strict=True):
            if state:
                self._adam.state[leaf] = {name: part[origin] if part.dim() else part for name, part in state.items()}
                self._adam.state[leaf]["exp_avg"][split] = 0
                self._adam.state[leaf]["exp_avg_sq"][split] = 0

    def _start(self, variables: V, decode: Callable[[V], Gaussians], lr: float) -> None:
        leaves = variables.map(lambda tensor: tensor.detach().clone().requires_grad_())
        # Both in one statement, since Ctrl-C may come between two, and they must fit each other.
        self._variables, self._decode = leaves, decode
        super().__init__({leaf: self._rates[name] for name, leaf in leaves.named().items()}, lr, fused=True)


def finite(some: list[Tensor]) -> bool:
    """Whether no tensor holds NaN or Inf."""
    return all(all_finite(tensor) for tensor in some)
