"""How much one query attends to each row of the geometry and the appearance memory (the paper's attention figures)."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.model.attention import CrossAttention
from querysplat_cli.model.decoders import Decoder, DecoderBlock
from querysplat_cli.model.memories import Memories, Memory
from querysplat_cli.model.querysplat import QuerySplat


@torch.no_grad()
def attention_of(
    model: QuerySplat, memories: Memories, anchors: Anchors | None, query: int
) -> tuple[Float[Tensor, "geometry"], Float[Tensor, "appearance"]]:
    """Cross-attention weights of one query over the rows of both memories; each sums to 1.

    They are means over heads and over the blocks whose attention counts (γ not all zero).
    """
    first: Tensor = model.geometry_queries
    if anchors is None:
        assert model.eye_token is not None
        first, query = torch.cat([model.eye_token, first]), query + 1
        near: tuple[Neighbours | None, ...] = (None, None, None)
    else:
        first = first + model.anchor_embedding(anchors.features)
        near = anchors.geometry, anchors.appearance, anchors.queries
    geometry, tokens = _weights(model.geometry_decoder, first, memories.geometry(near[0]), near[2], query)
    if anchors is None:
        tokens, query = tokens[1:], query - 1
    start = tokens + model.appearance_queries
    appearance, _ = _weights(model.appearance_decoder, start, memories.appearance(near[1]), near[2], query)
    return geometry, appearance


def _weights(
    decoder: Decoder, tokens: Tensor, memory: Memory, near_queries: Neighbours | None, query: int
) -> tuple[Tensor, Tensor]:
    """Mean weights, and the tokens after the decoder."""
    found = []
    for block in decoder.blocks:
        assert isinstance(block, DecoderBlock)
        if not block.cross_scale.is_inactive:
            found.append(_cross_weights(block.cross, tokens[[query]], memory, query))
        tokens = block(tokens, memory, near_queries)
    rows = len(memory.keys)
    return torch.stack(found).mean(0) if found else memory.keys.new_full((rows,), 1 / rows), tokens


def _cross_weights(cross: CrossAttention, token: Tensor, memory: Memory, query: int) -> Float[Tensor, "memory"]:
    keys, near = memory.keys, memory.neighbours
    asking = cross.q_norm(cross.q_proj(cross.norm(token)).unflatten(-1, (cross.heads, -1)))[0]
    rows = torch.arange(len(keys), device=keys.device) if near is None else near.index[query]
    logits = torch.einsum("hc,mhc->mh", asking, keys[rows].to(asking.dtype)) / asking.shape[-1] ** 0.5
    if near is not None:
        logits = logits + near.bias[query, :, None]
    return torch.zeros(len(keys), device=keys.device).index_add(0, rows, logits.softmax(0).mean(1).float())
