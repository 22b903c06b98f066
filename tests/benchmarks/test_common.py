"""What the benchmarks share: where data lies, the list of sets, tables, files, and scenes from samples."""

import importlib
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from common import arguments, builds, locations, output, samples
from common.photo_sets import PHOTO_SETS, USUAL, PhotoSet
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.adapt import Adapted
from training_scenes import TINY, sample

BENCHMARKS = Path(locations.__file__).parents[1]


@pytest.mark.parametrize("variable", [locations.PHOTOS, locations.FIXTURES])
def test_the_environment_says_where_data_lies(variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(variable, raising=False)
    assert locations.location(variable).parent == BENCHMARKS.parents[1] / "shared"
    monkeypatch.setenv(variable, str(tmp_path))
    assert locations.location(variable) == tmp_path
    assert locations.missing(variable) is None
    monkeypatch.setenv(variable, str(tmp_path / "nowhere"))
    assert variable in (locations.missing(variable) or "")


def test_a_benchmark_without_photos_names_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(locations.PHOTOS, str(tmp_path / "nowhere"))
    monkeypatch.setattr("sys.argv", ["benchmark"])
    with pytest.raises(SystemExit):
        arguments.PhotoParser("What it measures.").parse()
    assert locations.PHOTOS in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["benchmark", str(tmp_path), "--sets", "fox"])
    options = arguments.PhotoParser("What it measures.").parse()
    assert (options.data, options.sets) == (tmp_path, ["fox"])


def test_the_sets_are_divided() -> None:
    """Constants were chosen on four sets, and no benchmark reads the large photos unless it is told to."""
    tuned = {name for name, each in PHOTO_SETS.items() if each.use == "tuned on"}
    assert tuned == {"fortress", "dtu106", "kermit", "fox"}
    assert set(PHOTO_SETS) - set(USUAL) == {"highres/sceaux", "highres/brighton", "highres/banana"}


def test_a_long_set_is_read_at_even_distances(tmp_path: Path) -> None:
    (tmp_path / "long").mkdir()
    for number in range(9):
        (tmp_path / "long" / f"{number}.jpg").touch()
    whole, three = PhotoSet("a", "tuned on", "long"), PhotoSet("b", "tuned on", "long", count=3)
    assert whole.photos(tmp_path) == [tmp_path / "long"]
    assert [path.stem for path in three.photos(tmp_path)] == ["0", "4", "8"]


@pytest.mark.slow
def test_what_the_encoder_found_is_made_once(tmp_path: Path) -> None:
    made: list[Sample] = []

    def make() -> Sample:
        made.append(sample(0))
        return made[-1]

    first, second = (samples.kept_sample(tmp_path / "passes" / "a.safetensors", make) for _ in range(2))
    assert len(made) == 1
    assert torch.equal(first.views.images, second.views.images)


def test_tables_and_files_hold_what_was_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    @dataclass
    class Row:
        set: str
        psnr: float

    table = output.Table({"set": "", "dB": ".2f"})
    table.add("fox", 21.456)
    table.add("fortress", None)
    lines = ["| set | dB |", "| --- | --- |", "| fox | 21.46 |", "| fortress | – |"]
    assert capsys.readouterr().out.splitlines() == lines
    output.write_json(None, rows=[])
    output.write_json(tmp_path / "found.json", rows=[Row("fox", 21.456)])
    found = json.loads((tmp_path / "found.json").read_text())
    assert found == {"machine": output.machine(), "rows": [{"set": "fox", "psnr": 21.456}]}


@pytest.mark.slow
def test_a_scene_is_optimised_again_as_it_was() -> None:
    """The same queries and settings give the same Gaussians; other settings do not."""
    torch.manual_seed(0)
    model = QuerySplat(TINY).requires_grad_(False)
    scene = builds.build(model, sample(1), tto=4, prune="off")
    again = builds.optimised_again(model, scene, "off")
    assert torch.equal(again.gaussians.means, scene.adapted.gaussians.means)
    assert steps_of(again) == 4
    longer = builds.optimised_again(model, scene, "off", steps=6)
    assert steps_of(longer) == 6
    assert not torch.equal(longer.gaussians.means, scene.adapted.gaussians.means)


@pytest.mark.slow
def test_photos_of_other_exposures_keep_their_transforms_when_a_scene_is_optimised_again() -> None:
    torch.manual_seed(0)
    model, given = QuerySplat(TINY).requires_grad_(False), sample(1, inputs=3)
    given.views.images[1] *= 0.5
    scene = builds.build(model, given, tto=2, prune="off")
    again = builds.optimised_again(model, scene, "off")
    assert scene.exposures
    assert again.exposures
    assert torch.equal(again.exposures.matrices, scene.exposures.matrices)
    assert torch.equal(again.gaussians.means, scene.adapted.gaussians.means)


def steps_of(adapted: Adapted) -> int:
    ((_, result),) = adapted.runs
    return len(result.history)


@pytest.mark.parametrize("path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda path: path.stem)
def test_no_benchmark_names_a_folder_of_one_machine(path: Path) -> None:
    assert "../shared" not in path.read_text()


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_every_benchmark_finds_what_it_imports(name: str) -> None:
    assert importlib.import_module(name)
