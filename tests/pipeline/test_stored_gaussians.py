"""Where no step is taken, the Gaussians of a stored scene stay as its file has them."""

from dataclasses import replace

import pytest
import torch
from stored_scene import a_report, a_stored_scene

from querysplat_cli.pipeline.stored_gaussians import StoredGaussians, as_stored
from querysplat_cli.reporting.omissions import taken_further
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.tto.adapt import Adapted

SCENE, DECODED = a_stored_scene()
FILE = StoredGaussians(replace(DECODED, sh=DECODED.sh[:, :1])[:5], replace(DECODED, sh=DECODED.sh[:, :1])[5:])
"""The file of five decoded Gaussians without idle bands, and two of a backdrop."""


def same(one: Gaussians, two: Gaussians) -> bool:
    return all(torch.equal(*pair) for pair in zip(one.tensors(), two.tensors(), strict=True))


def test_bands_and_backdrop_are_those_of_the_file() -> None:
    found = as_stored(DECODED[:5], FILE, SCENE.cameras)
    assert same(found, joined(FILE.own, FILE.backdrop))


def test_what_decodes_with_more_digits_than_the_file_has_keeps_them() -> None:
    scales = DECODED.scales[:5] * 1.03
    found = as_stored(replace(DECODED[:5], scales=scales), FILE, SCENE.cameras)
    assert torch.equal(found.scales[:5], scales)


@pytest.mark.parametrize("field", ["means", "scales"])
def test_a_gaussian_that_was_drawn_in_stays_there(field: str) -> None:
    """Others that `convert` cut decided on that; decoded again, it would stand behind the backdrop."""
    away = getattr(DECODED, field)[:5].clone()
    away[2] *= 50
    found = as_stored(replace(DECODED[:5], **{field: away}), FILE, SCENE.cameras)
    assert same(found, joined(FILE.own, FILE.backdrop))


def test_gaussians_that_the_file_lacks_are_compared_with_none() -> None:
    """A file has finite Gaussians only."""
    found = as_stored(DECODED[:6], FILE, SCENE.cameras)
    assert len(found) == 8
    assert found.sh_degree == 0


@pytest.mark.parametrize("stay", [True, False])
def test_the_report_names_bands_that_are_still_left_out(stay: bool) -> None:
    line = {"what": "SH bands", "psnr_lost": 0.01}
    adapted = Adapted(SCENE.memories, DECODED, SCENE.cameras, ())
    found = taken_further(a_report(left_out=[line])["left_out"], adapted, bands_stay=stay, with_lpips=False)
    assert found == ([line] if stay else [])
