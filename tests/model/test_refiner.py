"""Attention over rows of one's own equals the textbook's, row by row."""

from dataclasses import replace

import pytest
import torch
from tests.model.model_scenes import compact
from torch.nn import functional as F

from querysplat_cli.model.config import ModelConfig, Refinement
from querysplat_cli.model.refiner import (
    APPEARANCE_ROW_OF_GAUSSIAN,
    APPEARANCE_ROW_OF_QUERY,
    GEOMETRY_ROW,
    PAIR_WIDTH,
    Evidence,
    PairAttention,
    Refiner,
)
from querysplat_cli.runtime.errors import QuerySplatError


@torch.no_grad()
def test_pair_attention_in_float64() -> None:
    torch.manual_seed(0)
    attention = PairAttention(16, 4).double()
    tokens, rows = torch.randn(5, 16).double(), torch.randn(5, 3, PAIR_WIDTH).double()
    counts = torch.tensor([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0], [1, 1, 0]]).bool()
    found, shares = attention(tokens, rows, counts)
    for query in range(5):
        read = attention.q_proj(attention.norm(tokens[query])).view(4, -1)
        both = attention.keys_and_values(F.gelu(rows[query, counts[query]])).view(-1, 2, 4, PAIR_WIDTH // 4)
        result, share = [], torch.zeros(3).double()
        for head in range(4):
            logits = [float(key @ read[head]) / (PAIR_WIDTH // 4) ** 0.5 for key in both[:, 0, head]]
            total = 1 + sum(torch.tensor(logit).double().exp() for logit in logits)
            weights = [torch.tensor(logit).double().exp() / total for logit in logits]
            share[counts[query]] += torch.tensor(weights).double() / 4
            zero = torch.zeros(PAIR_WIDTH // 4).double()
            result.append(sum((w * v for w, v in zip(weights, both[:, 1, head], strict=True)), zero))
        torch.testing.assert_close(found[query], attention.out_proj(torch.cat(result)))
        torch.testing.assert_close(shares[query], share)


def test_learned_queries_cannot_be_refined() -> None:
    with pytest.raises(QuerySplatError, match="anchored"):
        compact(queries="learned", refinement_rounds=1)


@pytest.mark.parametrize(
    ("kind", "geometry_is_read", "appearance_is_read"),
    [
        ("whole", (True, True), (False, True)),
        ("no-geometry-memory", (False, False), (False, True)),
        ("no-appearance-memory", (True, True), (False, False)),
        ("no-memory", (False, False), (False, False)),
        ("one-branch", (True, True), (True, True)),
    ],
)
def test_each_head_follows_the_memories_that_its_branch_reads(
    kind: Refinement, geometry_is_read: tuple[bool, bool], appearance_is_read: tuple[bool, bool]
) -> None:
    """Pairs say whether the geometry head and the appearance head change with a memory."""
    config = compact(refinement_rounds=1, refinement=kind)
    torch.manual_seed(0)
    refiner = Refiner(config).requires_grad_(False)
    for head in (refiner.geometry_head, refiner.appearance_head):
        head.weight.normal_()
    evidence = random_evidence(refiner, config)
    before = refiner(evidence, None)
    for part, expected in (("geometry", geometry_is_read), ("appearance", appearance_is_read)):
        after = refiner(replace(evidence, **{part: getattr(evidence, part) + 1}), None)
        heads = (before.geometry, after.geometry), (before.appearance, after.appearance)
        assert tuple(not torch.equal(one, other) for one, other in heads) == expected, part


def random_evidence(refiner: Refiner, config: ModelConfig) -> Evidence:
    """Of five queries, three views and two neighbours; every row counts."""
    appearance = APPEARANCE_ROW_OF_GAUSSIAN * config.gaussians_per_query + APPEARANCE_ROW_OF_QUERY
    return Evidence(
        own=torch.randn(5, refiner.embedding.in_features),
        geometry=torch.randn(5, 3, GEOMETRY_ROW),
        appearance=torch.randn(5, 3, appearance),
        seen=torch.ones(5, 3, dtype=torch.bool),
        views=torch.arange(3).expand(5, -1),
        near=torch.randint(5, (5, 2)),
        offsets=torch.randn(5, 2, 3),
    )
