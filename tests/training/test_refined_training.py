"""Rounds of refinement are trained on top of a model that stays as it is."""

from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import load_file

from querysplat_cli.training.config import StageSettings
from querysplat_cli.training.start import starting_model
from querysplat_cli.training.trainer import MODEL, STATE
from training_scenes import run, training


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
