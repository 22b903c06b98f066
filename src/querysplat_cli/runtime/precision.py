"""Number formats: matrix products in half precision on request; norms, softmax and rotations in float32."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.runtime.choices import Precision
from querysplat_cli.runtime.errors import QuerySplatError


class Linear(nn.Linear):
    """A linear layer that computes in the type of its weights, whatever the type of its input."""

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x.to(self.weight.dtype), self.weight, self.bias)


class Conv2d(nn.Conv2d):
    """A convolution that computes in the type of its weights, whatever the type of its input."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


class LayerNorm(nn.LayerNorm):
    """A norm that computes in the type of its weights, which is never half precision."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


def weight_dtypes(model: nn.Module, precision: Precision) -> dict[str, torch.dtype]:
    """The type of each tensor of `model` at `precision`, by name."""
    half = torch.bfloat16 if precision == "bf16" else torch.float32
    types = dict.fromkeys(model.state_dict(), torch.float32)
    for name, module in model.named_modules():
        if isinstance(module, Linear | Conv2d):
            types |= {f"{name}.{part}": half for part in module.state_dict()}
    return types


@contextmanager
def matrix_products(precision: Precision) -> Iterator[None]:
    """While inside, let GPUs round the operands of float32 products to TF32 if `precision` is tf32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if precision == "tf32" else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def check_precision(name: str) -> Precision:
    """`name` as a precision; raises QuerySplatError if it is none."""
    for known in get_args(Precision):
        if name == known:
            return known
    raise QuerySplatError(f"--precision {name}: no such precision", f"Choose {', '.join(get_args(Precision))}.")
