"""Adam with a way back over the last step, and to the mark before the last one."""

from collections.abc import Mapping

import torch
from torch import Tensor


class UndoableAdam:
    """Adam on tensors that require a gradient, each with a rate of its own relative to `lr`."""

    def __init__(
        self, rates: Mapping[Tensor, float], lr: float, *, betas: tuple[float, float] = (0.9, 0.999), fused: bool
    ) -> None:
        self._lr = lr
        self._leaves = list(rates)
        groups = [{"params": [leaf], "rate": rate} for leaf, rate in rates.items()]
        self._adam = torch.optim.Adam(groups, lr=lr, betas=betas, fused=fused)
        self.keep()

    def step(self, share: float) -> None:
        """One step at `share` of the rate."""
        for before, now in zip(self._before, self._leaves, strict=True):
            before.copy_(now.detach())
        for group in self._adam.param_groups:
            group["lr"] = self._lr * group["rate"] * share
        self._adam.step()
        self.forget_gradient()

    def forget_gradient(self) -> None:
        """The gradients since the last step take no part in the next one."""
        self._adam.zero_grad(set_to_none=True)

    def keep(self) -> None:
        """Return to nothing earlier than the tensors as they are now. Their gradients are forgotten."""
        self.forget_gradient()
        self._before = self._copied()
        self._marks = (self._copied(),) * 2

    def mark(self) -> None:
        """Keep the tensors as they are for `go_back`."""
        self._marks = self._marks[1], self._copied()

    def undo(self) -> None:
        """The tensors before the last step, at half the rate and without momentum.

        Squared gradients are kept: without them, Adam's next step would move every number by the whole rate, and be
        undone again.
        """
        self._return_to(self._before)

    def go_back(self) -> None:
        """Like `undo`, to the tensors at the mark before the last one, or as they were at first."""
        self._return_to(self._marks[0])
        self._marks = self._marks[0], self._marks[0]

    def _copied(self) -> list[Tensor]:
        return [leaf.detach().clone() for leaf in self._leaves]

    def _return_to(self, earlier: list[Tensor]) -> None:
        self._lr /= 2
        with torch.no_grad():
            for before, now in zip(earlier, self._leaves, strict=True):
                now.copy_(before)
        for state in self._adam.state.values():
            state["exp_avg"].zero_()
            state["exp_avg_sq"].nan_to_num_()
        self.forget_gradient()
