"""Attention over a memory or among queries, one scene at a time: [tokens, width], no batch."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.model.anchors import Neighbours
from querysplat_cli.model.local_attention import attend_near
from querysplat_cli.model.memories import Memory
from querysplat_cli.runtime.precision import LayerNorm, Linear


class LayerScale(nn.Module):
    """A learned gain for each channel of a residual branch."""

    def __init__(self, width: int, start: float = 5e-5) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), start))

    @property
    def is_inactive(self) -> bool:
        """Whether the branch adds exactly nothing and is frozen, so that it can be skipped."""
        return not self.gamma.requires_grad and not bool(self.gamma.any())

    def forward(self, update: Float[Tensor, "tokens width"]) -> Float[Tensor, "tokens width"]:
        return self.gamma * update


class CrossAttention(nn.Module):
    """Queries read a memory whose keys are already normed, so only queries are normed here (paper, section 3.3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = LayerNorm(width)
        self.q_proj = Linear(width, width)
        self.q_norm = LayerNorm(width // heads)
        self.out_proj = Linear(width, width)

    def forward(self, tokens: Float[Tensor, "queries width"], memory: Memory) -> Float[Tensor, "queries width"]:
        query = self.q_norm(self.q_proj(self.norm(tokens)).unflatten(-1, (self.heads, -1)))
        return self.out_proj(attend(query, memory, self.out_proj.weight.dtype))


class SelfAttention(nn.Module):
    """Queries read one another; queries and keys are normed by head (paper, section 3.3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = LayerNorm(width)
        self.qkv = Linear(width, 3 * width)
        self.q_norm = LayerNorm(width // heads)
        self.k_norm = LayerNorm(width // heads)
        self.out_proj = Linear(width, width)

    def forward(
        self, tokens: Float[Tensor, "queries width"], near: Neighbours | None = None
    ) -> Float[Tensor, "queries width"]:
        query, key, value = self.qkv(self.norm(tokens)).unflatten(-1, (3, self.heads, -1)).unbind(1)
        return self.out_proj(attend(self.q_norm(query), Memory(self.k_norm(key), value, near), value.dtype))


def attend(
    query: Float[Tensor, "queries heads channels"], memory: Memory, dtype: torch.dtype | None = None
) -> Float[Tensor, "queries width"]:
    """softmax(q·kᵀ/√channels + bias)·v by head, heads concatenated.

    With neighbours, query i reads only the rows neighbours.index[i], to whose logits neighbours.bias[i] is added.
    Without, it reads all rows, and the products are taken in `dtype` (by default the queries').
    """
    keys, values = memory.keys, memory.values
    if memory.neighbours is None:
        q, k, v = (part.to(dtype or query.dtype).transpose(0, 1)[None] for part in (query, keys, values))
        return F.scaled_dot_product_attention(q, k, v)[0].transpose(0, 1).flatten(1)
    same = replace(memory, keys=keys.to(query.dtype), values=values.to(query.dtype))
    return attend_near(query, same).flatten(1)
