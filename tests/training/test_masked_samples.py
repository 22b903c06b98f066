"""Samples whose masks leave no block, so that they have no query."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.training.data import CachedSamples, Draw
from querysplat_cli.training.passes import read_sample, write_sample
from querysplat_cli.training.trainer import MODEL
from training_scenes import run, training

REASON = "the masks hide nearly all of every photo"


def hide(path: Path) -> None:
    found = read_sample(path)
    views = replace(found.views, masks=torch.zeros_like(found.views.masks))
    write_sample(path, replace(found, views=views))


def test_a_sample_without_a_block_is_skipped_and_counted(tmp_path: Path) -> None:
    """Its error ended the whole training."""
    config = training(tmp_path / "cache")
    samples = CachedSamples(config.data, config.seed)
    drawn = [samples.path(Draw(step, 0, config.stages[0].inputs)) for step in range(config.steps)]
    assert set(drawn) != {drawn[0]}
    hide(drawn[0])
    assert run(config, tmp_path / "run").skipped == {REASON: drawn.count(drawn[0])}


def test_a_training_whose_samples_are_all_like_that_makes_no_model(tmp_path: Path) -> None:
    config = replace(training(tmp_path / "cache", scenes=1), save_every=100)
    (path,) = CachedSamples(config.data, config.seed).paths(config.stages[0].inputs)
    hide(path)
    with pytest.raises(QuerySplatError, match=REASON):
        run(config, tmp_path / "run")
    assert not (tmp_path / "run" / MODEL).exists()
