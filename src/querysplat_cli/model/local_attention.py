"""Attention of each query to a few memory rows: the equations in plain torch, and compiled for a CPU.

With p the rows of a query, s = (q·kₚ)/√channels + bₚ and w = softmax(s), the result is Σₚ wₚ·vₚ. Given the
gradient g of the result: ∂vₚ = wₚ·g, ∂sₚ = wₚ·(g·vₚ − Σ wg·v), ∂q = Σₚ ∂sₚ·kₚ/√channels, ∂kₚ = ∂sₚ·q/√channels.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from querysplat_cli.model.compiled_attention import attend_forward, backward_to_memory, backward_to_queries
from querysplat_cli.model.memories import Memory


def attend_near(
    query: Float[Tensor, "queries heads channels"], memory: Memory
) -> Float[Tensor, "queries heads channels"]:
    """Each query i attends to the rows neighbours.index[i], to whose logits neighbours.bias[i] is added.

    Differentiable once, with respect to query, keys and values; the same bits on every run. Raises
    IndexError when a neighbour is not a row of the memory.
    """
    near = memory.neighbours
    assert near is not None
    if query.device.type != "cpu":
        return gather_and_attend(query, memory)
    if near.index.numel() and not 0 <= int(near.index.min()) <= int(near.index.max()) < len(memory.keys):
        raise IndexError(f"neighbours up to {int(near.index.max())} in a memory of {len(memory.keys)} rows")
    attended: Tensor = _AttendNear.apply(query, memory.keys, memory.values, near.index, near.bias.to(query.dtype))
    return attended


def gather_and_attend(
    query: Float[Tensor, "queries heads channels"], memory: Memory
) -> Float[Tensor, "queries heads channels"]:
    """The same in plain torch, on any device and differentiable any number of times."""
    keys, values, near = memory.keys, memory.values, memory.neighbours
    assert near is not None
    # `embedding` gathers rows, and its backward adds them up in a fixed order.
    seen_keys = F.embedding(near.index, keys.flatten(1)).unflatten(-1, keys.shape[1:])
    seen_values = F.embedding(near.index, values.flatten(1)).unflatten(-1, values.shape[1:])
    logits = (query[:, None] * seen_keys).sum(-1) / query.shape[-1] ** 0.5 + near.bias[..., None]
    return (logits.softmax(1)[..., None] * seen_values).sum(1)


class _AttendNear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, query: Tensor, keys: Tensor, values: Tensor, index: Tensor, bias: Tensor) -> Tensor:
        query, keys, values, index = (part.detach().contiguous() for part in (query, keys, values, index))
        attended = torch.empty_like(query)
        weights = query.new_empty(*query.shape[:2], index.shape[1])
        attend_forward(*_arrays(query, keys, values, index, bias.contiguous(), attended, weights))
        ctx.save_for_backward(query, keys, values, index, weights)
        return attended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        query, keys, values, index, weights = ctx.saved_tensors
        given = given.contiguous()
        by_query, by_key, by_value = torch.empty_like(query), torch.empty_like(keys), torch.empty_like(values)
        by_logit = torch.empty_like(weights)
        backward_to_queries(*_arrays(query, keys, values, index, weights, given, by_query, by_logit))
        backward_to_memory(*_arrays(query, index, weights, by_logit, given, by_key, by_value))
        return by_query, by_key, by_value, None, None


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)
