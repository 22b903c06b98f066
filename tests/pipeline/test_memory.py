"""Which photos are kept when not all fit."""

from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.memory import MemoryNeeds, within_memory
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.runtime.device import free_bytes
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.views import Photo
from tiny_weights import MODEL, OMEGA, write_weights

PHOTOS = [Photo(f"{i}.png", Path(f"{i}.png"), np.zeros((4, 4, 3), np.uint8)) for i in range(40)]


def test_as_many_as_fit(tmp_path: Path) -> None:
    model = QuerySplat(MODEL).requires_grad_(False)
    encoder = find_encoder("vggt_omega", EncoderOptions(write_weights(tmp_path), mixture=model.layer_weights))
    needs = MemoryNeeds(encoder, model, 512)
    needed = [needs.bytes(views) or 0 for views in range(1, 41)]
    assert needed == sorted(needed)
    assert model.bytes_needed(9, 512, 5, optimising=True) > model.bytes_needed(9, 512, 5)
    free = int(needed[16] / PIPELINE_POLICY.memory_share) + 2
    kept, left_out, expected = within_memory(PHOTOS, needs, free, None)
    assert len(kept) == 17
    assert expected == needed[16]
    assert {photo.name for photo in kept} | {each.name for each in left_out} == {photo.name for photo in PHOTOS}
    assert "17 views" in left_out[0].why
    kept, _, _ = within_memory(PHOTOS, needs, free, 5)
    assert [photo.name for photo in kept] == ["0.png", "10.png", "20.png", "29.png", "39.png"]
    with pytest.raises(QuerySplatError, match="one view"):
        within_memory(PHOTOS, needs, 2**20, None)


def test_an_encoder_without_an_estimate_is_not_limited() -> None:
    needs = MemoryNeeds(find_encoder("classical"), QuerySplat(MODEL), 448)
    kept, left_out, expected = within_memory(PHOTOS, needs, 1, None)
    assert (len(kept), left_out, expected) == (40, [], None)


def test_depth_and_separate_layers_take_more() -> None:
    plain = OMEGA.working_bytes(10, 512, False, mixed=True, depth=False)
    assert OMEGA.working_bytes(10, 512, True, mixed=True, depth=False) < plain
    assert OMEGA.working_bytes(10, 512, False, mixed=True, depth=True) > plain
    assert OMEGA.working_bytes(10, 512, False, mixed=False, depth=False) > plain
    assert OMEGA.working_bytes(20, 512, False, mixed=True, depth=False) > plain


def test_free_memory_is_that_of_the_machine() -> None:
    assert free_bytes(torch.device("cpu")) > 2**26
