"""Local attention against dense attention with a mask, against finite differences, and run twice."""

import math

import pytest
import torch
from model_scenes import neighbours

from querysplat_cli.model.anchors import Neighbours
from querysplat_cli.model.attention import attend
from querysplat_cli.model.decoders import Decoder
from querysplat_cli.model.local_attention import attend_near, gather_and_attend
from querysplat_cli.model.memories import Memory


def numbers(*shape: int, seed: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()


def masked(query: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, near: Neighbours) -> torch.Tensor:
    """Dense attention in which every other row's logit is −∞."""
    bias = torch.full((len(query), len(keys)), -math.inf, dtype=query.dtype).scatter(1, near.index, near.bias)
    logits = torch.einsum("qhc,mhc->hqm", query, keys) / math.sqrt(query.shape[-1]) + bias
    return torch.einsum("hqm,mhc->qhc", logits.softmax(-1), values)


@pytest.mark.parametrize("local", [attend_near, gather_and_attend])
@pytest.mark.parametrize(
    ("queries", "rows", "heads", "channels", "near"), [(40, 30, 3, 5, 4), (1, 1, 1, 1, 1), (9, 200, 4, 32, 8)]
)
def test_equals_dense_attention_with_a_mask(
    local, queries: int, rows: int, heads: int, channels: int, near: int
) -> None:  # type: ignore[no-untyped-def]
    q, k, v = (
        numbers(queries, heads, channels, seed=0),
        numbers(rows, heads, channels, seed=1),
        numbers(rows, heads, channels, seed=2),
    )
    some = neighbours(0, queries, rows, near, torch.float64)
    g = numbers(queries, heads, channels, seed=3).detach()
    ours, dense = local(q, Memory(k, v, some)), masked(q, k, v, some)
    torch.testing.assert_close(ours, dense, rtol=1e-12, atol=1e-13)
    for a, b in zip(torch.autograd.grad(ours, (q, k, v), g), torch.autograd.grad(dense, (q, k, v), g), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)


def test_gradients_are_finite_differences() -> None:
    near = neighbours(1, 6, 5, 3, torch.float64)
    inputs = (numbers(6, 2, 3, seed=0), numbers(5, 2, 3, seed=1), numbers(5, 2, 3, seed=2))
    assert torch.autograd.gradcheck(lambda q, k, v: attend_near(q, Memory(k, v, near)), inputs)


def test_a_row_named_twice_counts_twice() -> None:
    q, k, v = numbers(1, 1, 2, seed=0), numbers(3, 1, 2, seed=1), numbers(3, 1, 2, seed=2)
    twice = Neighbours(torch.tensor([[1, 1, 2]]), torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(attend_near(q, Memory(k, v, twice)), gather_and_attend(q, Memory(k, v, twice)))
    slopes = zip(
        torch.autograd.grad(attend_near(q, Memory(k, v, twice)).sum(), (k, v)),
        torch.autograd.grad(gather_and_attend(q, Memory(k, v, twice)).sum(), (k, v)),
        strict=True,
    )
    for a, b in slopes:
        torch.testing.assert_close(a, b)
        assert not a[0].any(), "no query attends to row 0"


def test_float32_keeps_close_to_float64_at_large_logits_and_repeats_bit_for_bit() -> None:
    near = neighbours(2, 500, 300, 4)
    q, k, v = (numbers(n, 4, 32, seed=n, dtype=torch.float32) for n in (500, 300, 301))
    v = v[:300]
    in_float64 = Neighbours(near.index, near.bias.double())
    exact = gather_and_attend(q.double(), Memory(30 * k.double(), v.double(), in_float64))
    again = [attend_near(q, Memory(30 * k, v, near)) for _ in range(2)]
    assert torch.equal(*again)
    assert float((again[0] - exact).detach().abs().max()) < 1e-4  # 1.5e-5 seen; logits reach 100
    slopes = [torch.autograd.grad(one.square().sum(), (q, k, v), retain_graph=True) for one in again]
    assert all(torch.equal(a, b) for a, b in zip(*slopes, strict=True))


def test_a_neighbour_outside_the_memory_is_refused() -> None:
    q, k, v = numbers(1, 1, 2, seed=0), numbers(3, 1, 2, seed=1), numbers(3, 1, 2, seed=2)
    for row in (3, -1):
        near = Neighbours(torch.tensor([[row]]), torch.zeros(1, 1, dtype=torch.float64))
        with pytest.raises(IndexError):
            attend_near(q, Memory(k, v, near))


def test_attending_to_everything_is_global_attention() -> None:
    q, k, v = numbers(4, 2, 3, seed=0), numbers(7, 2, 3, seed=1), numbers(7, 2, 3, seed=2)
    everything = Neighbours(torch.arange(7).expand(4, -1), torch.zeros(4, 7, dtype=torch.float64))
    torch.testing.assert_close(attend(q, Memory(k, v)), attend(q, Memory(k, v, everything)))


def test_a_frozen_branch_of_scale_zero_is_skipped_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    decoder = Decoder(2, 16, 2, 4.0)
    for block in decoder.blocks:
        block.self_attention_scale.gamma.data.zero_()
        block.mlp_scale.gamma.data.zero_()
    tokens, memory = torch.randn(5, 16), Memory(torch.randn(9, 2, 8), torch.randn(9, 2, 8))
    learning = decoder(tokens, memory)
    decoder.requires_grad_(False)
    for block in decoder.blocks:
        for branch in (block.self_attention, block.mlp):
            monkeypatch.setattr(branch, "forward", None)
    assert torch.equal(decoder(tokens, memory), learning)
