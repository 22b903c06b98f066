"""Attention of each query to a few memory rows: the equations in plain torch, and compiled for a CPU.

With p the rows of a query, s = (q·kₚ)/√channels + bₚ and w = softmax(s), the result is Σₚ wₚ·vₚ. Given the
gradient g of the result: ∂vₚ = wₚ·g, ∂sₚ = wₚ·(g·vₚ − Σ wg·v), ∂q = Σₚ ∂sₚ·kₚ/√channels, ∂kₚ = ∂sₚ·q/√channels.
"""

from typing import Any

import numba as nb
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from querysplat_cli.model.anchors import Neighbours

SUMS = {"reassoc", "contract", "nsz"}
"""Sums may be vectorised; NaN and infinities stay what they are."""


def attend_near(
    query: Float[Tensor, "queries heads channels"],
    keys: Float[Tensor, "memory heads channels"],
    values: Float[Tensor, "memory heads channels"],
    near: Neighbours,
) -> Float[Tensor, "queries heads channels"]:
    """Each query i attends to the rows near.index[i], whose logits get near.bias[i].

    Differentiable once, with respect to query, keys and values; the same bits on every run. Raises
    IndexError when a neighbour is not a row of the memory.
    """
    if query.device.type != "cpu":
        return gather_and_attend(query, keys, values, near)
    if near.index.numel() and not 0 <= int(near.index.min()) <= int(near.index.max()) < len(keys):
        raise IndexError(f"neighbours up to {int(near.index.max())} in a memory of {len(keys)} rows")
    attended: Tensor = _AttendNear.apply(query, keys, values, near.index, near.bias.to(query.dtype))
    return attended


def gather_and_attend(
    query: Float[Tensor, "queries heads channels"],
    keys: Float[Tensor, "memory heads channels"],
    values: Float[Tensor, "memory heads channels"],
    near: Neighbours,
) -> Float[Tensor, "queries heads channels"]:
    """The same in plain torch, on any device and differentiable at will."""
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
        _forward(*_arrays(query, keys, values, index, bias.contiguous(), attended, weights))
        ctx.save_for_backward(query, keys, values, index, weights)
        return attended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        query, keys, values, index, weights = ctx.saved_tensors
        given = given.contiguous()
        by_query, by_key, by_value = torch.empty_like(query), torch.empty_like(keys), torch.empty_like(values)
        by_logit = torch.empty_like(weights)
        _backward_queries(*_arrays(query, keys, values, index, weights, given, by_query, by_logit))
        _backward_memory(*_arrays(query, index, weights, by_logit, given, by_key, by_value))
        return by_query, by_key, by_value, None, None


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)


@nb.njit(cache=True, error_model="numpy", fastmath=SUMS, parallel=True)
def _forward(
    query: np.ndarray,
    keys: np.ndarray,
    values: np.ndarray,
    index: np.ndarray,
    bias: np.ndarray,
    attended: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Fill attended [queries, heads, channels] and weights [queries, heads, near]."""
    queries, heads, channels = query.shape
    near = index.shape[1]
    zero = query.dtype.type(0)
    scale = query.dtype.type(1 / np.sqrt(channels))
    for i in nb.prange(queries):
        for h in range(heads):
            q, w, result = query[i, h], weights[i, h], attended[i, h]
            top = query.dtype.type(-np.inf)
            for p in range(near):
                k = keys[index[i, p], h]
                dot = zero
                for c in range(channels):
                    dot += q[c] * k[c]
                w[p] = dot * scale + bias[i, p]
                top = max(top, w[p])
            total = zero
            for p in range(near):
                w[p] = np.exp(w[p] - top)
                total += w[p]
            for c in range(channels):
                result[c] = zero
            for p in range(near):
                w[p] /= total
                share, v = w[p], values[index[i, p], h]
                for c in range(channels):
                    result[c] += share * v[c]


@nb.njit(cache=True, error_model="numpy", fastmath=SUMS, parallel=True)
def _backward_queries(
    query: np.ndarray,
    keys: np.ndarray,
    values: np.ndarray,
    index: np.ndarray,
    weights: np.ndarray,
    given: np.ndarray,
    by_query: np.ndarray,
    by_logit: np.ndarray,
) -> None:
    """Fill by_query, and by_logit with ∂s/√channels."""
    queries, heads, channels = query.shape
    near = index.shape[1]
    zero = query.dtype.type(0)
    scale = query.dtype.type(1 / np.sqrt(channels))
    for i in nb.prange(queries):
        for h in range(heads):
            g, w, slope, result = given[i, h], weights[i, h], by_logit[i, h], by_query[i, h]
            mean = zero
            for p in range(near):
                v = values[index[i, p], h]
                dot = zero
                for c in range(channels):
                    dot += g[c] * v[c]
                slope[p] = dot
                mean += w[p] * dot
            for c in range(channels):
                result[c] = zero
            for p in range(near):
                slope[p] = w[p] * (slope[p] - mean) * scale
                change, k = slope[p], keys[index[i, p], h]
                for c in range(channels):
                    result[c] += change * k[c]


@nb.njit(cache=True, error_model="numpy", fastmath=SUMS, parallel=True)
def _backward_memory(
    query: np.ndarray,
    index: np.ndarray,
    weights: np.ndarray,
    by_logit: np.ndarray,
    given: np.ndarray,
    by_key: np.ndarray,
    by_value: np.ndarray,
) -> None:
    """Fill by_key and by_value, each row by one thread and in the order of the queries."""
    heads, channels = query.shape[1:]
    near = index.shape[1]
    zero = query.dtype.type(0)
    start, visits = _visits(index, len(by_key))
    for row in nb.prange(len(by_key)):
        for h in range(heads):
            k, v = by_key[row, h], by_value[row, h]
            for c in range(channels):
                k[c], v[c] = zero, zero
            for visit in visits[start[row] : start[row + 1]]:
                i, p = visit // near, visit % near
                q, g = query[i, h], given[i, h]
                change, share = by_logit[i, h, p], weights[i, h, p]
                for c in range(channels):
                    k[c] += change * q[c]
                    v[c] += share * g[c]


@nb.njit(cache=True)
def _visits(index: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Which entries of `index` name each row: visits[start[row] : start[row + 1]], in ascending order."""
    named = index.ravel()
    start = np.zeros(rows + 1, np.int64)
    for row in named:
        start[row + 1] += 1
    start = np.cumsum(start)
    free = start.copy()
    visits = np.empty(len(named), np.int64)
    for entry in range(len(named)):
        visits[free[named[entry]]] = entry
        free[named[entry]] += 1
    return start, visits
