"""Learning rates, loss weights, growing queries, the loss-rank filter, and the average of the weights."""

import math
from itertools import pairwise

import pytest
import torch
from torch import nn

from querysplat_cli.model.config import ModelConfig
from querysplat_cli.model.initialise import scratch_model
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.training.config import LossSettings, OptimiserSettings, StageSettings, load_config
from querysplat_cli.training.schedule import Average, RankFilter, grow_queries, rate, weights
from querysplat_cli.training.start import new_optimiser


def test_the_rate_rises_for_a_twentieth_and_falls_along_a_cosine() -> None:
    stage = StageSettings(steps=1000, lr=1e-4)
    rates = [rate(step, stage) for step in range(1000)]
    assert rates[0] == pytest.approx(2e-6)
    assert rates[49] == pytest.approx(1e-4)
    assert rates[50] == pytest.approx(1e-4)
    assert rates[525] == pytest.approx(0.5e-4, rel=1e-3)
    assert 0 < rates[-1] < 1e-9
    assert all(a < b for a, b in pairwise(rates[:50]))
    assert all(a >= b for a, b in pairwise(rates[50:]))


def test_the_papers_weights_over_the_papers_steps() -> None:
    losses = load_config("paper").losses
    start, early, later = weights(0, losses), weights(10_000, losses), weights(120_000, losses)
    assert (start.visibility, start.chamfer, start.opacity_floor, start.perceptual) == (1, 1, 0.1, 0)
    assert (early.visibility, early.chamfer, early.opacity_floor, early.perceptual) == (1, 0.5, 0.05, 0)
    assert (later.visibility, later.chamfer, later.opacity_floor, later.perceptual) == (1, 0, 0, 0.05)
    assert weights(100_000, losses).perceptual == 0
    assert weights(105_000, losses).perceptual == pytest.approx(0.025)


def test_the_papers_stages() -> None:
    config = load_config("paper")
    assert [(stage.steps, stage.lr, stage.queries, stage.inputs) for stage in config.stages] == [
        (300_000, 1e-4, 1024, (4, 4)),
        (30_000, 1e-5, 2048, (2, 12)),
        (30_000, 1e-5, 4096, (2, 12)),
        (30_000, 1e-5, 8192, (2, 12)),
    ]
    assert config.at(299_999) == (0, 0)
    assert config.at(300_000) == (1, 300_000)
    assert config.at(389_999) == (3, 360_000)
    optimiser = config.optimiser
    assert optimiser.batch == 64
    assert (optimiser.clip, optimiser.ema, optimiser.keep, optimiser.precision) == (1.0, 0.9995, 0.95, "bf16")
    assert config.model.scale_cap == 0.075
    assert config.losses == LossSettings()


def test_a_stored_average_goes_where_the_model_is() -> None:
    """The state of a training is read on the CPU; "meta" stands for a GPU here."""
    model = nn.Linear(2, 3)
    stored = {name: tensor.detach().clone() for name, tensor in model.named_parameters()}
    average = Average(model.to("meta"), 0.9, stored)
    assert {tensor.device.type for tensor in average.values.values()} == {"meta"}


def test_an_average_starts_anew_with_a_tensor_that_grew() -> None:
    """A stage whose queries grow was not saved where its first step was skipped."""
    model = nn.Linear(2, 3)
    average = Average(model, 0.9)
    model.weight = nn.Parameter(torch.ones(5, 2))
    average.fit(model)
    assert average.values["weight"].equal(torch.ones(5, 2))


def test_weight_decay_acts_on_matrices_outside_of_the_heads() -> None:
    model = QuerySplat(ModelConfig(width=16, heads=2, mixed_layers=2, query_count=5, vgm_width=8))
    named = dict(model.named_parameters())
    optimiser = new_optimiser(model, OptimiserSettings(weight_decay=0.3))
    groups = {group["weight_decay"]: {id(tensor) for tensor in group["params"]} for group in optimiser.param_groups}
    assert set(groups) == {0.3, 0.0}
    decaying = {name for name, tensor in named.items() if id(tensor) in groups[0.3]}
    assert len(decaying) + len(groups[0.0]) == len(named)
    spared = set(named) - decaying
    assert all(named[name].ndim >= 2 for name in decaying)
    kinds = ("bias", "norm.weight", "gamma", "_head.weight", "k_norm.weight", "q_norm.weight")
    assert all(name.endswith(kinds) or named[name].ndim == 1 for name in spared)
    assert {"geometry_head.weight", "geometry_memory.proj.bias", "layer_mixer.norm.weight"} <= spared
    assert {"geometry_memory.proj.weight", "geometry_decoder.blocks.0.mlp.fc1.weight", "geometry_queries"} <= decaying


def test_weights_from_scratch_start_as_in_the_release() -> None:
    config = ModelConfig(width=64, heads=4, geometry_blocks=1, appearance_blocks=1, query_count=8, vgm_width=64)
    model = scratch_model(config, seed=3)
    assert float(model.geometry_head.weight.detach().std()) == pytest.approx(0.002, rel=0.02)
    assert not model.geometry_head.bias.any()
    # torch's default for a linear layer: uniform up to 1/√width.
    assert float(model.appearance_head.weight.detach().abs().max()) == pytest.approx(1 / 8, rel=0.01)
    assert float(model.geometry_queries.std()) == pytest.approx(0.01, rel=0.2)
    assert not model.appearance_queries.any()
    assert torch.equal(scratch_model(config, seed=3).appearance_head.weight, model.appearance_head.weight)


def test_grown_queries_are_the_old_ones_and_perturbed_copies() -> None:
    torch.manual_seed(0)
    model = QuerySplat(
        ModelConfig(width=16, heads=2, geometry_blocks=1, appearance_blocks=1, query_count=5, vgm_width=16)
    )
    before = model.geometry_queries.detach().clone()
    grow_queries(model, 12, torch.Generator().manual_seed(0))
    after = model.geometry_queries.detach()
    assert after.shape == (12, 16)
    assert model.config.query_count == 12
    assert len(model.appearance_queries) == 12
    assert torch.equal(after[:5], before)
    apart = after[5:] - before[torch.arange(7) % 5]
    assert 0.005 < float(apart.std()) < 0.02
    assert (apart.abs().amax(1) > 0).all()
    assert model.geometry_queries.requires_grad


def test_the_filter_leaves_out_the_worst_twentieth_late_in_training() -> None:
    settings = OptimiserSettings(window=100, keep=0.95, keep_from=0.5)
    ranks = RankFilter(settings)
    ranks.add([float(i) for i in range(99)])
    assert ranks.keeps(1e9, 0.9), "the window is not full"
    ranks.add([99.0, math.nan])
    assert len(ranks.window) == 100
    assert ranks.keeps(1e9, 0.49)
    assert [loss for loss in range(100) if not ranks.keeps(float(loss), 0.5)] == [95, 96, 97, 98, 99]
    assert RankFilter(settings, ranks.window).keeps(94.0, 1.0)


def test_the_average_is_an_exponential_one() -> None:
    model = nn.Linear(2, 1)
    model.bias.requires_grad_(False)
    average = Average(model, 0.9)
    assert set(average.values) == {"weight"}
    expected = model.weight.detach().clone()
    for step in range(100, 105):
        with torch.no_grad():
            model.weight += 1
        average.update(model, step)
        expected = 0.9 * expected + 0.1 * model.weight.detach()
    torch.testing.assert_close(average.values["weight"], expected)
