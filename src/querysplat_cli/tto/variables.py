"""What test-time optimisation changes, and Adam on it with a way back over the last step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.splat.render import all_finite
from querysplat_cli.tto.rendering_loss import RenderingLoss

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


class UndoableAdam(Generic[V]):
    """Variables under Adam (β 0.9, 0.999), what they were before the last step, and at the last two marks."""

    def __init__(self, start: Parametrisation[V], lr: float) -> None:
        self._marks: tuple[V, V]
        self._lr, self._rates = lr, start.rates
        self._start(start.variables, start.decode)

    def gaussians(self) -> Gaussians:
        """Decoded from the variables, and differentiable in them."""
        return self._decode(self._leaves)

    def variables(self) -> V:
        """The variables as they are, without a gradient."""
        return self._leaves.map(Tensor.detach)

    def gradient_is_finite(self) -> bool:
        return finite([tensor.grad for tensor in self._leaves.tensors() if tensor.grad is not None])

    def step(self, share: float) -> None:
        """One step at `share` of the rate."""
        for before, now in zip(self._before.tensors(), self._leaves.tensors(), strict=True):
            before.copy_(now.detach())
        for group in self._adam.param_groups:
            group["lr"] = self._lr * group["rate"] * share
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def mark(self) -> None:
        """Keep the variables as they are for `go_back`."""
        self._marks = self._marks[1], self.variables().map(Tensor.clone)

    def undo(self) -> None:
        """The variables before the last step, at half the rate and without momentum.

        Squared gradients are kept: without them, Adam's next step would move every number by the whole rate, and be
        undone again.
        """
        self._return_to(self._before)

    def go_back(self) -> None:
        """Like `undo`, to the variables at the mark before the last one, or when the rows were taken."""
        self._return_to(self._marks[0])
        self._marks = self._marks[0], self._marks[0]

    def _return_to(self, earlier: V) -> None:
        self._lr /= 2
        with torch.no_grad():
            for before, now in zip(earlier.tensors(), self._leaves.tensors(), strict=True):
                now.copy_(before)
        for state in self._adam.state.values():
            state["exp_avg"].zero_()
            state["exp_avg_sq"].nan_to_num_()
        self._adam.zero_grad(set_to_none=True)

    def go_on_with(self, denser: Denser[V]) -> None:
        """Take other rows. Each inherits the moments of its origin, unless the origin was split."""
        moments = [self._adam.state[tensor] for tensor in self._leaves.tensors()]
        self._start(denser.variables, denser.decode)
        origin = denser.origin
        split = origin.bincount()[origin] > 1
        for tensor, state in zip(self._leaves.tensors(), moments, strict=True):
            if state:
                self._adam.state[tensor] = {name: part[origin] if part.dim() else part for name, part in state.items()}
                self._adam.state[tensor]["exp_avg"][split] = 0
                self._adam.state[tensor]["exp_avg_sq"][split] = 0

    def _start(self, variables: V, decode: Callable[[V], Gaussians]) -> None:
        leaves = variables.map(lambda tensor: tensor.detach().clone().requires_grad_())
        # Both in one statement, since Ctrl-C may come between two, and they must fit each other.
        self._leaves, self._decode = leaves, decode
        self._before = variables.map(lambda tensor: tensor.detach().clone())
        self._marks = (variables.map(Tensor.detach),) * 2
        groups = [{"params": [tensor], "rate": self._rates[name]} for name, tensor in leaves.named().items()]
        self._adam = torch.optim.Adam(groups, lr=self._lr, fused=True)


def finite(some: list[Tensor]) -> bool:
    """Whether no tensor holds NaN or Inf."""
    return all(all_finite(tensor) for tensor in some)
