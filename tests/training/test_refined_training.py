"""Rounds of refinement are trained on top of a model that stays as it is."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from querysplat_cli.queries.evidence import gather_evidence
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.training.config import StageSettings
from querysplat_cli.training.start import decays, freeze, starting_model
from querysplat_cli.training.step import anchored, decoded
from querysplat_cli.training.trainer import MODEL, STATE
from training_scenes import run, sample, training


def test_rounds_of_refinement_learn_and_the_model_below_stays(tmp_path: Path) -> None:
    """They start from a checkpoint without rounds, whose scene is theirs at first."""
    below = training(tmp_path / "cache", stages=(StageSettings(steps=2, lr=1e-3),))
    run(below, tmp_path / "below")
    config = replace(
        below,
        start=str(tmp_path / "below" / MODEL),
        model=replace(below.model, refinement_rounds=2),
        losses=replace(below.losses, background="random"),
        stages=(StageSettings(steps=4, lr=1e-3),),
    )
    run(config, tmp_path / "refined")
    before, after = starting_model(config).state_dict(), load_file(tmp_path / "refined" / STATE)
    changed = {name for name, tensor in before.items() if not torch.equal(tensor, after[f"model.{name}"])}
    assert changed
    assert all(name.startswith("refiner.") for name in changed), changed


def test_in_bf16_rounds_read_the_scene_in_float32(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """bf16 has eight bits: a projection would be off by pixels."""
    config = training(tmp_path / "cache")
    model = starting_model(replace(config, model=replace(config.model, refinement_rounds=2)))
    read = []

    def spied(anchors, scene, raw, *others):  # type: ignore[no-untyped-def]
        read.append((torch.is_autocast_enabled("cpu"), scene.means.dtype, raw.dtype))
        return gather_evidence(anchors, scene, raw, *others)

    monkeypatch.setattr("querysplat_cli.queries.refine.gather_evidence", spied)
    scene = sample(0)
    assert len(list(decoded(model, scene, anchored(scene), "bf16"))) == 2
    assert read == [(False, torch.float32, torch.float32)] * 2


def test_weight_decay_spares_the_heads_of_rounds(tmp_path: Path) -> None:
    config = training(tmp_path)
    config = replace(config, model=replace(config.model, refinement_rounds=1))
    named = dict(starting_model(config).named_parameters())
    heads = {name for name in named if name.startswith("refiner.") and name.endswith("_head.weight")}
    assert heads
    assert not any(decays(name, named[name]) for name in heads)
    assert any(decays(name, tensor) for name, tensor in named.items() if name.startswith("refiner."))


@pytest.mark.parametrize("frozen", ["refiner", "refiner."])
def test_a_training_that_freezes_all_rounds_is_refused(tmp_path: Path, frozen: str) -> None:
    config = training(tmp_path)
    config = replace(
        config,
        model=replace(config.model, refinement_rounds=1),
        optimiser=replace(config.optimiser, frozen=(frozen,)),
    )
    with pytest.raises(QuerySplatError, match="all that learns"):
        freeze(starting_model(config), config)
