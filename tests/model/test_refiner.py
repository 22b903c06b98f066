"""Attention over rows of one's own equals the textbook's, row by row."""

import pytest
import torch
from tests.model.model_scenes import compact
from torch.nn import functional as F

from querysplat_cli.model.refiner import PAIR_WIDTH, PairAttention
from querysplat_cli.runtime.errors import QuerySplatError


@torch.no_grad()
def test_pair_attention_in_float64() -> None:
    torch.manual_seed(0)
    attention = PairAttention(16, 4).double()
    tokens, rows = torch.randn(5, 16).double(), torch.randn(5, 3, PAIR_WIDTH).double()
    counts = torch.tensor([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0], [1, 1, 0]]).bool()
    found = attention(tokens, rows, counts)
    for query in range(5):
        read = attention.q_proj(attention.norm(tokens[query])).view(4, -1)
        both = attention.keys_and_values(F.gelu(rows[query, counts[query]])).view(-1, 2, 4, PAIR_WIDTH // 4)
        result = []
        for head in range(4):
            logits = [float(key @ read[head]) / (PAIR_WIDTH // 4) ** 0.5 for key in both[:, 0, head]]
            total = 1 + sum(torch.tensor(logit).double().exp() for logit in logits)
            weights = [torch.tensor(logit).double().exp() / total for logit in logits]
            zero = torch.zeros(PAIR_WIDTH // 4).double()
            result.append(sum((w * v for w, v in zip(weights, both[:, 1, head], strict=True)), zero))
        torch.testing.assert_close(found[query], attention.out_proj(torch.cat(result)))


def test_learned_queries_cannot_be_refined() -> None:
    with pytest.raises(QuerySplatError, match="anchored"):
        compact(queries="learned", refinement_rounds=1)
