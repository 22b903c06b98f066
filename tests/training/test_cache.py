"""The samples in the cache: which ones are impossible, and which ones are drawn from."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.progress import silent
from querysplat_cli.training.config import DataSettings, SourceSettings
from querysplat_cli.training.data import CachedSamples, cache_folder, prepare_samples, wanted_samples
from querysplat_cli.training.plan import _ready
from querysplat_cli.training.sources import open_source
from training_scenes import sample, training

ROOM = SourceSettings("procedural", scenes=2, size=(60, 66), inputs=(2, 2), targets=1, cameras="posed")


class Losing:
    """An engine all of whose workers are killed."""

    def run(self, handler: Any, setup: Any, jobs: Any, done: Any, heard: Any = None) -> None:
        for job in jobs:
            done(job, "its process was ended by SIGKILL")


def refuse(error: QuerySplatError) -> Any:
    def refused(*_: Any, **__: Any) -> None:
        raise error

    return refused


@pytest.mark.parametrize("fault", ["disk", "weights", "worker"])
def test_a_sample_is_impossible_only_by_its_own_fault(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk, missing weights and killed workers marked samples that are sound, for good."""
    data = DataSettings((ROOM,), cache=str(tmp_path), max_size=66)
    made = refuse(MissingPart("no weights")) if fault == "weights" else lambda *_, **__: sample(0)
    monkeypatch.setattr("querysplat_cli.training.data.make_sample", made)
    engine = {"engine": Losing()} if fault == "worker" else {}
    with monkeypatch.context() as patch:
        if fault == "disk":
            full = QuerySplatError("the disk is full")
            patch.setattr("querysplat_cli.training.data.write_sample", refuse(full))
        said = {"disk": "the disk is full", "weights": "no weights", "worker": "2 samples could not be made, as 000000"}
        with pytest.raises(QuerySplatError, match=said[fault]):
            prepare_samples(data, lambda: None, progress=silent, **engine)  # type: ignore[arg-type, return-value]
    assert not list(cache_folder(data, ROOM).glob("*.failed"))


def test_the_samples_of_all_processes_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of two processes counted what the other one had made by chance until then."""
    data = DataSettings((ROOM,), cache=str(tmp_path), max_size=66)
    monkeypatch.setattr("querysplat_cli.training.data.make_sample", lambda *_, **__: sample(0))

    def other() -> None:
        prepare_samples(data, lambda: None, rank=1, world=2, progress=silent)  # type: ignore[arg-type, return-value]

    found = prepare_samples(data, lambda: None, rank=0, world=2, wait=other, progress=silent)  # type: ignore[arg-type, return-value]
    assert found.ready == 2


def test_samples_of_other_trainings_are_not_drawn(tmp_path: Path) -> None:
    """More draws of a scene, made for another training, lie in the same folder."""
    data = training(tmp_path, scenes=2).data
    own = CachedSamples(data, 0).paths((2, 2))
    assert [path.stem for path in own] == ["000000-000", "000001-000"]
    for stem in ("000000-001", "000002-000"):
        own[0].with_name(f"{stem}.safetensors").write_bytes(own[0].read_bytes())
    assert CachedSamples(data, 0).paths((2, 2)) == own
    assert _ready(data, data.sources[0]) == 2


def test_a_scene_that_is_added_leaves_the_samples_of_the_others(tmp_path: Path) -> None:
    """Samples had the number of their scene, which shifts, so those of one scene passed for another's."""
    settings = SourceSettings("captured", (str(tmp_path),), inputs=(2, 2), targets=1)
    data = DataSettings((settings,), cache=str(tmp_path / "cache"))
    names = {}
    for scene in ("b c", "a"):
        (tmp_path / scene).mkdir()
        for number in range(12):
            cv2.imwrite(str(tmp_path / scene / f"{number}.png"), np.zeros((70, 90, 3), np.uint8))
        source = open_source(settings)
        captures = {source.name(number).partition("-")[0]: source.capture(number, 0) for number in range(len(source))}
        samples = zip(sorted(captures), wanted_samples(data, data.sources), strict=True)
        names[scene] = {name: (each.path.name, captures[name].inputs) for name, each in samples}
    assert names["a"]["b_c"] == names["b c"]["b_c"]
    assert names["b c"]["b_c"][0].startswith("b_c-")
    assert set(names["a"]) == {"a", "b_c"}
