"""What a query attends to, against attention written out."""

from dataclasses import replace

import pytest
import torch
from model_scenes import anchors, compact, memories

from querysplat_cli.model.attention import CrossAttention
from querysplat_cli.model.attention_maps import attention_of, valueless
from querysplat_cli.model.initialise import initial_model
from querysplat_cli.model.memories import Memories, Memory
from querysplat_cli.runtime.errors import QuerySplatError
from tiny_weights import MODEL, write_model


def test_learned_queries(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """With a value of 1 in one row and 0 elsewhere, the decoder's attention output is that row's weight."""
    model = write_model(tmp_path / "a.safetensors", MODEL)
    generator = torch.Generator().manual_seed(0)
    shape = (30, MODEL.heads, MODEL.width // MODEL.heads)
    stored = Memories(*(torch.randn(shape, generator=generator) for _ in range(4)))
    found = attention_of(model, stored, None, query=7)
    geometry, appearance = found.geometry, found.appearance
    torch.testing.assert_close(geometry.sum(), torch.tensor(1.0))
    torch.testing.assert_close(appearance.sum(), torch.tensor(1.0))
    seen: list[torch.Tensor] = []

    def listen(cross: CrossAttention, inputs: tuple[torch.Tensor, Memory], output: torch.Tensor) -> None:
        tokens, keys = inputs[0], inputs[1].keys
        query = cross.q_norm(cross.q_proj(cross.norm(tokens)).unflatten(-1, (cross.heads, -1)))
        logits = torch.einsum("qhc,mhc->hqm", query, keys) / query.shape[-1] ** 0.5
        seen.append(logits.softmax(-1).mean(0))

    blocks = [*model.geometry_decoder.blocks, *model.appearance_decoder.blocks]
    hooks = [block.cross.register_forward_hook(listen) for block in blocks]
    model.decode(stored)
    for hook in hooks:
        hook.remove()
    torch.testing.assert_close(geometry, torch.stack([weights[8] for weights in seen[:2]]).mean(0))  # after the eye
    torch.testing.assert_close(appearance, seen[2][7])


def test_anchored_queries_attend_to_their_neighbours_alone() -> None:
    model = initial_model(compact(), seed=0)
    where = anchors(model.config)
    found = attention_of(model, memories(model.config), where, query=3)
    geometry, appearance = found.geometry, found.appearance
    assert set(geometry.nonzero()[:, 0].tolist()) == set(where.geometry.index[3].tolist())
    assert set(appearance.nonzero()[:, 0].tolist()) == set(where.appearance.index[3].tolist())
    torch.testing.assert_close(geometry.sum(), torch.tensor(1.0))


def test_one_branch_shares_its_attention_between_both_memories() -> None:
    """The rows of each memory keep their own places, and all weights together sum to 1."""
    config = compact(branches="one", appearance_blocks=0)
    model, where, stored = initial_model(config, seed=0), anchors(config), memories(config)
    found = attention_of(model, stored, where, query=3)
    assert set(found.geometry.nonzero()[:, 0].tolist()) == set(where.geometry.index[3].tolist())
    assert set(found.appearance.nonzero()[:, 0].tolist()) == set(where.appearance.index[3].tolist())
    torch.testing.assert_close(found.geometry.sum() + found.appearance.sum(), torch.tensor(1.0))
    assert 0 < float(found.appearance.sum()) < 1


def test_a_model_without_appearance_blocks_has_no_attention_to_draw() -> None:
    config = compact(appearance_blocks=0)
    with pytest.raises(QuerySplatError, match="no appearance block"):
        attention_of(initial_model(config, seed=0), memories(config), anchors(config), query=0)


def test_memories_without_values_are_named() -> None:
    config = compact()
    stored = memories(config)
    assert valueless(stored) == ()
    assert valueless(replace(stored, geometry_values=torch.zeros_like(stored.geometry_values))) == ("geometry",)
