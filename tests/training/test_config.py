"""Trainings from TOML: presets, changes, and what is refused."""

import json
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.model.config import ModelConfig, preset
from querysplat_cli.model.initialise import initial_model
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.training.config import from_table, load_config, training_presets


@pytest.mark.parametrize("name", training_presets())
def test_presets_load_and_survive_json(name: str) -> None:
    config = load_config(name)
    assert from_table(json.loads(json.dumps(asdict(config)))) == config


def test_the_compact_training_is_of_the_compact_model_and_trains_something() -> None:
    config = load_config("compact")
    assert config.model == replace(preset("compact"), refinement_rounds=0)
    assert load_config("compact-refined").model == preset("compact")
    names = [name for name, _ in initial_model(config.model, 0).named_parameters()]
    frozen = [name for name in names if name.startswith(config.optimiser.frozen)]
    assert frozen
    assert len(frozen) < len(names)
    unused = [start for start in config.optimiser.frozen if not any(name.startswith(start) for name in names)]
    assert not unused, "names of no tensor"


@pytest.mark.parametrize(("whole", "prefix"), [("ablation", ""), ("small", "small-")])
def test_ablations_change_one_thing_and_are_matched_in_parameters(whole: str, prefix: str) -> None:
    def parameters(model: ModelConfig) -> int:
        with torch.device("meta"):
            return sum(parameter.numel() for parameter in QuerySplat(model).parameters())

    full = load_config(whole)
    for name in ("one-branch", "no-appearance"):
        ablated = load_config(f"{prefix}{name}")
        assert ablated.model != full.model
        assert replace(ablated, model=full.model) == full
        assert parameters(ablated.model) == pytest.approx(parameters(full.model), rel=0.01)
    late = load_config(f"{prefix}no-early-regularisation")
    assert (late.losses.chamfer, late.losses.opacity_floor) == (0, 0)
    losses = replace(late.losses, chamfer=full.losses.chamfer, opacity_floor=full.losses.opacity_floor)
    assert replace(late, losses=losses) == full


def test_the_papers_ablations_are_half_of_its_base_stage() -> None:
    """The changes of the losses come at the same shares of the steps as in the whole training's base stage."""
    paper, ablation = load_config("paper"), load_config("ablation")
    (stage,) = ablation.stages
    assert stage == replace(paper.stages[0], steps=150_000)
    for name in ("lpips_start", "lpips_ramp", "anneal"):
        assert 2 * getattr(ablation.losses, name) == getattr(paper.losses, name)
    same = {name: getattr(paper.losses, name) for name in ("lpips_start", "lpips_ramp", "anneal")}
    assert replace(ablation, stages=paper.stages, losses=replace(ablation.losses, **same)) == paper
    assert load_config("vggt").stages == ablation.stages


def test_a_file_changes_a_preset_and_set_changes_both(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('base = "paper"\nseed = 3\n[losses]\nchamfer = 0.5\n')
    config = load_config(
        str(path), ["losses.chamfer=0.25", "stages.0.steps=7", "data.cache=there", "optimiser.clip = 2"]
    )
    assert (config.seed, config.losses.chamfer, config.losses.visibility) == (3, 0.25, 1.0)
    assert (config.stages[0].steps, config.stages[1].steps) == (7, 30_000)
    assert config.data.cache == "there"
    assert config.optimiser.clip == 2.0


@pytest.mark.parametrize(
    "change",
    [
        "nothing",
        "unknown=1",
        "losses.unknown=1",
        "losses.chamfer=-1",
        "losses.chamfer=much",
        "optimiser.clip=0",
        "optimiser.precision=fp8",
        "optimiser.compile=1",
        "stages.9.steps=1",
        "stages.0.steps=0",
        "stages.0.steps=1.5",
        "stages.0.queries=9000",
        "stages=[]",
        "data.sources.0.inputs=[1, 4]",
        "data.sources.0.inputs=[4, 2]",
        "data.sources.0.inputs=[4]",
        "data.sources.0.size=[168,120]",
        "data.sources.0.size=[0,0]",
        "data.sources.0.scenes=-5",
        "data.sources.0.seed=-1",
        "seed=-1",
        "optimiser.betas=[2,3]",
        "optimiser.weight_decay=-1",
        "losses.alpha_min=0",
        "model.scale_cap=-1",
        "model.patch=500",
        "data.sources.0.kind=film",
        "seed.more=1",
        "model.width=-1",
        "model.branches=one",
    ],
)
def test_wrong_changes_are_refused_with_a_clear_message(change: str) -> None:
    with pytest.raises(QuerySplatError) as error:
        load_config("paper", [change])
    assert error.value.hint
    assert "\n" not in error.value.message


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a = ",
        'base = "nobody"',
        "data = 3",
        "[data]\nsources = []\n",
        "\x00",
        'stages = [{lr = 1.0}]\nbase = "paper"',
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(QuerySplatError):
        load_config(str(path))


@given(st.text(max_size=30), st.text(max_size=30))
def test_no_change_crashes(name: str, value: str) -> None:
    with suppress(QuerySplatError):
        load_config("compact", [f"{name}={value}"])


def test_missing_files_and_presets_are_refused(tmp_path: Path) -> None:
    for source in (str(tmp_path / "no.toml"), "nobody"):
        with pytest.raises(QuerySplatError):
            load_config(source)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("steps = 1" + "0" * 5000, "no TOML"),
        ("a = " + "[" * 5000, "no TOML"),
        ("base = 3", "no other training"),
        ("base = 'SELF'", "no other training"),
    ],
)
def test_hostile_files_are_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "t.toml"
    path.write_text(content.replace("SELF", str(path)))
    with pytest.raises(QuerySplatError, match=message):
        load_config(str(path), ())
    with pytest.raises(QuerySplatError, match="cannot be read"):
        load_config("compact", ("seed=1" + "0" * 5000,))


def test_a_captured_source_without_places_is_refused() -> None:
    """The message sent users to .failed files, of which there were none."""
    with pytest.raises(QuerySplatError, match="is captured, and has no places"):
        load_config("compact", ("data.sources.0.kind='captured'",))
