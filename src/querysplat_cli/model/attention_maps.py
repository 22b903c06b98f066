"""How much one query attends to each row of the geometry and the appearance memory (the paper's attention figures)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.model.attention import CrossAttention
from querysplat_cli.model.decoders import Decoder, DecoderBlock
from querysplat_cli.model.memories import Memories, Memory
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.errors import QuerySplatError


@dataclass(frozen=True)
class Attention:
    """Cross-attention weights of one query over the rows of both memories, means over heads and attending blocks.

    With two branches, each sums to 1. With one branch, whose queries read both memories at once, both together do.
    """

    geometry: Float[Tensor, "geometry"]
    appearance: Float[Tensor, "appearance"]


@torch.no_grad()
def attention_of(model: QuerySplat, memories: Memories, anchors: Anchors | None, query: int) -> Attention:
    """The attention of one query.

    Blocks count whose attention is scaled by more than zero (γ). Raises QuerySplatError where a branch has no such
    block, because there is no attention to show then.
    """
    first: Tensor = model.geometry_queries
    if anchors is None:
        assert model.eye_token is not None
        first, query = torch.cat([model.eye_token, first]), query + 1
        near: tuple[Neighbours | None, ...] = (None, None)
    else:
        first = first + model.anchor_embedding(anchors.features)
        near = anchors.appearance, anchors.queries
    memory = model.first_memory(memories, anchors)
    weights, tokens = _weights("geometry", model.geometry_decoder, first, (memory, near[1]), query)
    if model.config.branches == "one":
        rows = len(memories.geometry_keys)
        return Attention(weights[:rows], weights[rows:])
    if anchors is None:
        tokens, query = tokens[1:], query - 1
    start = tokens + model.appearance_queries
    read = memories.appearance(near[0]), near[1]
    appearance, _ = _weights("appearance", model.appearance_decoder, start, read, query)
    return Attention(weights, appearance)


def valueless(memories: Memories) -> tuple[str, ...]:
    """The memories whose values are all zero: what queries attend to in them changes nothing."""
    values = {"geometry": memories.geometry_values, "appearance": memories.appearance_values}
    return tuple(name for name, each in values.items() if not bool(each.any()))


def _weights(
    branch: str, decoder: Decoder, tokens: Tensor, read: tuple[Memory, Neighbours | None], query: int
) -> tuple[Tensor, Tensor]:
    """Mean weights, and the tokens after the decoder. `read` holds the memory and the neighbours among queries."""
    memory, near_queries = read
    found = []
    for block in decoder.blocks:
        assert isinstance(block, DecoderBlock)
        if not block.cross_scale.is_inactive:
            found.append(_cross_weights(block.cross, tokens[[query]], memory, query))
        tokens = block(tokens, memory, near_queries)
    if not found:
        raise QuerySplatError(
            f"no {branch} block of this model attends to its memory, so there is no attention to draw",
            "Inspect a scene of a model whose two branches attend, such as `compact`.",
        )
    return torch.stack(found).mean(0), tokens


def _cross_weights(cross: CrossAttention, token: Tensor, memory: Memory, query: int) -> Float[Tensor, "memory"]:
    keys, near = memory.keys, memory.neighbours
    asking = cross.q_norm(cross.q_proj(cross.norm(token)).unflatten(-1, (cross.heads, -1)))[0]
    rows = torch.arange(len(keys), device=keys.device) if near is None else near.index[query]
    logits = torch.einsum("hc,mhc->mh", asking, keys[rows].to(asking.dtype)) / asking.shape[-1] ** 0.5
    if near is not None:
        logits = logits + near.bias[query, :, None]
    return torch.zeros(len(keys), device=keys.device).index_add(0, rows, logits.softmax(0).mean(1).float())
