"""How many regions photos become, and where --regions cannot be had."""

from dataclasses import replace
from pathlib import Path

import pytest

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.pipeline.regions.build import region_count
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError


def some_encoder(*, own_frame: bool) -> Encoder:
    encoder = find_encoder("classical")
    encoder.own_frame = own_frame
    return encoder


@pytest.mark.parametrize(("photos", "count"), [(1, 1), (100, 1), (101, 2), (300, 5), (1000, 17)])
def test_auto_divides_many_photos(photos: int, count: int) -> None:
    settings = ReconstructSettings((), Path())
    assert region_count(settings, photos, some_encoder(own_frame=False)) == count
    assert region_count(settings, photos, some_encoder(own_frame=True)) == 1
    assert region_count(replace(settings, budget=9.0), photos, some_encoder(own_frame=False)) == 1  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "own_frame", "words"),
    [
        ({}, True, "takes all photos at once"),
        ({"budget": 60.0}, False, "--budget"),
        ({"refine_cameras": True}, False, "--refine-cameras"),
        ({"regions": 6}, False, "too few"),
    ],
)
def test_regions_that_cannot_be_had(changes: dict[str, object], own_frame: bool, words: str) -> None:
    settings = replace(ReconstructSettings((), Path(), regions=2), **changes)  # type: ignore[arg-type]
    with pytest.raises(QuerySplatError, match=words):
        region_count(settings, 20, some_encoder(own_frame=own_frame))  # type: ignore[arg-type]
