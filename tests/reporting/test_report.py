"""The entries of a report as JSON."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from querysplat_cli.reporting.report import settings_entry, tto_entries
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.plan import TtoRun

ONE_STEP = TtoRun("features", TtoSettings(3, 0.1))


def test_settings_keep_their_types_in_json() -> None:
    settings = {"inputs": (Path("a"), Path("b")), "budget": 2.5, "force": True, "tto": None, "weights": Path("w")}
    written = json.loads(json.dumps(settings_entry(settings)))
    assert written == {"inputs": ["a", "b"], "budget": 2.5, "force": True, "tto": None, "weights": "w"}


def test_refined_cameras_are_reported_in_degrees_shares_and_pixels() -> None:
    """One of two cameras, a unit apart, is turned and shifted. Its picture of a distant wall moves by both together."""
    focal, depth, turn, shift = 100.0, 5.0, 0.01, 0.02
    w2c = torch.eye(4).repeat(2, 1, 1)
    w2c[1, 0, 3] = -1
    before = Cameras(w2c, torch.tensor([[focal, 0, 50], [0, focal, 50], [0, 0, 1]]).repeat(2, 1, 1), 100, 100)
    after = before.perturbed(torch.tensor([[turn, 0, 0], [0, 0, 0]]), torch.tensor([[0, shift, 0], [0, 0, 0]]))
    across, down = torch.meshgrid(torch.linspace(-0.1, 0.1, 5), torch.linspace(-0.1, 0.1, 5), indexing="xy")
    count = across.numel()
    gaussians = Gaussians(
        torch.stack([across.flatten(), down.flatten(), torch.full((count,), depth)], 1),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.01),
        torch.full((count,), 0.5),
        torch.zeros(count, 1, 3),
    )
    result = TtoResult(gaussians, gaussians, 1.0, 0.5, (), before, after)
    (kept,) = tto_entries([(ONE_STEP, replace(result, cameras=before))])
    assert kept["cameras"] is None
    (entry,) = tto_entries([(ONE_STEP, result)])
    assert entry["cameras"]["degrees"] == pytest.approx(math.degrees(turn) / 2, abs=1e-3)
    assert entry["cameras"]["focal"] == 1
    moved = focal * abs(math.tan(turn) - shift / depth)
    assert entry["cameras"]["pixels"] == pytest.approx(moved / 2, rel=0.02)


def test_a_shift_is_a_share_of_the_cameras_extent_also_far_from_the_origin() -> None:
    """Of more than 25 cameras, torch finds distances from squares by default. Those of 1,000 hide an extent of 0.3."""
    w2c = torch.eye(4).repeat(31, 1, 1)
    w2c[:, 0, 3] = -1000 - 0.01 * torch.arange(31)
    before = Cameras(w2c, torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]).repeat(31, 1, 1), 100, 100)
    after = before.perturbed(torch.zeros(31, 3), torch.tensor([0, 0.03, 0]).repeat(31, 1))
    gaussians = Gaussians(
        torch.tensor([[1000.0, 0, 5]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.01),
        torch.ones(1) / 2,
        torch.zeros(1, 1, 3),
    )
    (entry,) = tto_entries([(ONE_STEP, TtoResult(gaussians, gaussians, 1.0, 0.5, (), before, after))])
    assert entry["cameras"]["shift"] == pytest.approx(0.1, rel=0.01)
