"""How many regions photos become, and where --regions cannot be had."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.regions.build import _carry_out, region_count
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.engine import Done, Handler, Heard
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.pictures import write_picture


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


def test_a_region_is_shown_once(tmp_path: Path) -> None:
    """Its first report only says that it begins, as the stage does."""

    def report(handler: Handler, setup: None, folders: Sequence[Path], done: Done, heard: Heard) -> None:
        for text, fraction in (("", 0.0), ("depth", 0.5)):
            heard(folders[0], text, fraction)
        done(folders[0], None)

    said: list[tuple[str, str, float]] = []
    stages = Stages(lambda stage, text, fraction: said.append((stage, text, fraction)))
    _carry_out([tmp_path / "region-1"], SimpleNamespace(run=report), stages)
    assert said == [("region-1", "", 0.0), ("region-1", "depth", 0.5), ("region-1", "", 1.0)]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cluster": "tcp://127.0.0.1:9"}, "no scheduler answers"),
        ({"regions": 3}, "8 photos with cameras are too few"),
        ({"budget": 60.0}, "--budget"),
    ],
)
def test_what_cannot_be_had_is_said_before_cameras_are_found(
    changes: dict[str, object], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("querysplat_cli.runtime.cluster.ANSWER_SECONDS", 1)
    for number in range(8):
        write_picture(tmp_path / "photos" / f"{number}.png", np.full((64, 64, 3), number, np.uint8))
    settings = replace(ReconstructSettings((tmp_path / "photos",), tmp_path / "a.ply", regions=2), **changes)  # type: ignore[arg-type]
    stages = Stages()
    with pytest.raises(QuerySplatError, match=words):
        reconstruct(settings, stages)
    assert "cameras" not in stages.seconds
    assert [each.name for each in tmp_path.iterdir()] == ["photos"]
