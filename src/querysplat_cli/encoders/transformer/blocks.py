"""The transformer block of both VGMs. Its parts have the names of the checkpoints."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.encoders.transformer.rotary import Rotation
from querysplat_cli.runtime.precision import Conv2d, LayerNorm, Linear


class LayerScale(nn.Module):
    """A learned gain for each channel of a residual branch."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, update: Float[Tensor, "*groups width"]) -> Float[Tensor, "*groups width"]:
        return self.gamma * update


class MaskedLinear(Linear):
    """W·x + bias ⊙ bias_mask; the mask is stored with the weights (1 for queries and values, 0 for keys)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        self.bias_mask: Tensor
        self.register_buffer("bias_mask", torch.ones(outputs))

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x.to(self.weight.dtype), self.weight, self.bias * self.bias_mask)


class PatchConvolution(nn.Module):
    """Patches to tokens. It exists for the name `proj` of the checkpoints."""

    def __init__(self, width: int, patch: int) -> None:
        super().__init__()
        self.proj = Conv2d(3, width, patch, patch)


class Attention(nn.Module):
    """Self-attention. With `normed`, queries and keys are normalised head by head before any rotation."""

    def __init__(self, width: int, heads: int, *, normed: bool, masked: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = (MaskedLinear if masked else Linear)(width, 3 * width)
        self.q_norm = LayerNorm(width // heads) if normed else nn.Identity()
        self.k_norm = LayerNorm(width // heads) if normed else nn.Identity()
        self.proj = Linear(width, width)

    def queries_keys_values(
        self, tokens: Float[Tensor, "groups tokens width"], rotation: Rotation | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values [groups, heads, tokens, channels], normalised and rotated."""
        query, key, value = self.qkv(tokens).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        query, key = self.q_norm(query), self.k_norm(key)
        if rotation:
            query, key = rotation.apply(query), rotation.apply(key)
        return query.to(value.dtype), key.to(value.dtype), value

    def forward(
        self, tokens: Float[Tensor, "groups tokens width"], rotation: Rotation | None = None
    ) -> Float[Tensor, "groups tokens width"]:
        attended = F.scaled_dot_product_attention(*self.queries_keys_values(tokens, rotation))
        return self.proj(attended.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Widen, exact GELU, narrow."""

    def __init__(self, width: int, hidden: int, outputs: int | None = None) -> None:
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.fc2 = Linear(hidden, outputs or width)

    def forward(self, tokens: Float[Tensor, "*groups width"]) -> Float[Tensor, "*groups outputs"]:
        return self.fc2(F.gelu(self.fc1(tokens)))


class Block(nn.Module):
    """x + γ₁·attention(norm(x)), then x + γ₂·MLP(norm(x)); see docs/reference/official-checkpoint.md."""

    def __init__(self, width: int, heads: int, *, normed: bool, masked: bool, eps: float = 1e-5) -> None:
        super().__init__()
        self.norm1 = LayerNorm(width, eps=eps)
        self.attn = Attention(width, heads, normed=normed, masked=masked)
        self.ls1 = LayerScale(width)
        self.norm2 = LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, 4 * width)
        self.ls2 = LayerScale(width)

    def forward(
        self, tokens: Float[Tensor, "groups tokens width"], rotation: Rotation | None = None
    ) -> Float[Tensor, "groups tokens width"]:
        """Each group attends to itself only."""
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens), rotation))
        return tokens + self.ls2(self.mlp(self.norm2(tokens)))

    def within_(self, tokens: Float[Tensor, "views tokens width"], rotation: Rotation | None, chunk: int) -> None:
        """`forward` in place, `chunk` views at a time: wide intermediate results exist for these views only."""
        for part in tokens.split(chunk):
            part.copy_(self(part, rotation))

    def across_(self, tokens: Float[Tensor, "views tokens width"], rotation: Rotation | None, chunk: int) -> None:
        """In place, with the tokens of all views as one sequence. Only the attention takes all views at once."""
        views, count, width = tokens.shape
        shape = (1, self.attn.heads, views * count, width // self.attn.heads)
        query, key, value = (
            torch.empty(shape, dtype=self.attn.qkv.weight.dtype, device=tokens.device) for _ in range(3)
        )
        parts = tokens.split(chunk)
        spans = [slice(i * chunk * count, (i * chunk + len(part)) * count) for i, part in enumerate(parts)]
        for part, span in zip(parts, spans, strict=True):
            pieces = self.attn.queries_keys_values(self.norm1(part), rotation)
            for whole, piece in zip((query, key, value), pieces, strict=True):
                whole[0, :, span] = piece.transpose(0, 1).flatten(1, 2)
        attended = F.scaled_dot_product_attention(query, key, value)[0]
        del query, key, value
        for part, span in zip(parts, spans, strict=True):
            update = attended[:, span].transpose(0, 1).reshape(part.shape)
            part += self.ls1(self.attn.proj(update))
            part += self.ls2(self.mlp(self.norm2(part)))
