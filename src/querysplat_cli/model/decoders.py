"""The decoder that both branches use: queries read a memory, then one another, then pass an MLP."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from querysplat_cli.model.anchors import Neighbours
from querysplat_cli.model.attention import CrossAttention, LayerScale, SelfAttention
from querysplat_cli.model.memories import Memory
from querysplat_cli.runtime.precision import LayerNorm, Linear


class Mlp(nn.Module):
    """Norm, widen, exact GELU, narrow."""

    def __init__(self, width: int, ratio: float) -> None:
        super().__init__()
        self.norm = LayerNorm(width)
        self.fc1 = Linear(width, int(width * ratio))
        self.fc2 = Linear(int(width * ratio), width)

    def forward(self, tokens: Float[Tensor, "tokens width"]) -> Float[Tensor, "tokens width"]:
        return self.fc2(F.gelu(self.fc1(self.norm(tokens))))


class DecoderBlock(nn.Module):
    """Cross-attention, self-attention, MLP; each pre-normed, scaled, and added (paper, section 3.3).

        t ─┬─ norm ─ cross(K, V) ─ γ ─(+)─┬─ norm ─ self ─ γ ─(+)─┬─ norm ─ MLP ─ γ ─(+)─ t
           └──────────────────────────────┘└─────────────────────┘└────────────────────┘

    A branch whose frozen γ is all zero is left out: it would add exactly nothing.
    """

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.cross = CrossAttention(width, heads)
        self.cross_scale = LayerScale(width)
        self.self_attention = SelfAttention(width, heads)
        self.self_attention_scale = LayerScale(width)
        self.mlp = Mlp(width, mlp_ratio)
        self.mlp_scale = LayerScale(width)

    def forward(
        self, tokens: Float[Tensor, "queries width"], memory: Memory, near_queries: Neighbours | None = None
    ) -> Float[Tensor, "queries width"]:
        if not self.cross_scale.is_inactive:
            tokens = tokens + self.cross_scale(self.cross(tokens, memory))
        if not self.self_attention_scale.is_inactive:
            tokens = tokens + self.self_attention_scale(self.self_attention(tokens, near_queries))
        if not self.mlp_scale.is_inactive:
            tokens = tokens + self.mlp_scale(self.mlp(tokens))
        return tokens


class Decoder(nn.Module):
    """Blocks in a row, all reading the same memory."""

    def __init__(self, blocks: int, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(DecoderBlock(width, heads, mlp_ratio) for _ in range(blocks))

    def forward(
        self, tokens: Float[Tensor, "queries width"], memory: Memory, near_queries: Neighbours | None = None
    ) -> Float[Tensor, "queries width"]:
        """The tokens after all blocks.

        For a gradient, a block whose queries read the whole memory is run a second time in the backward pass. To
        store its intermediate results for thousands of queries would take gigabytes a block.
        """
        for block in self.blocks:
            if memory.neighbours is None and torch.is_grad_enabled():
                tokens = checkpoint(block, tokens, memory, use_reentrant=False)
            else:
                tokens = block(tokens, memory, near_queries)
        return tokens
