"""`querysplat inspect` on scenes of both presets."""

import json
from pathlib import Path

import cv2
import pytest
import torch
from rooms import take_photos

from querysplat_cli.cli import run
from querysplat_cli.commands.inspect import on_patches
from querysplat_cli.runtime.errors import ExitCode
from tiny_weights import write_weights

pytest.importorskip("matplotlib")


def test_rows_go_back_to_their_patches() -> None:
    """Two views of 1 special token and 2 × 3 patches; the places of four of their fourteen rows are given."""
    rows = torch.tensor([0, 3, 7, 13])
    found = on_patches(torch.tensor([0.4, 0.3, 0.2, 0.1]), rows, views=2, layout=(1, 2, 3))
    expected = torch.zeros(2, 2, 3)
    expected[0, 0, 2], expected[1, 1, 2] = 0.3, 0.1
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("preset", "canvas"), [("official-8192", 128), ("compact", 132)])
def test_pictures_of_a_scene(preset: str, canvas: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take_photos(tmp_path / "photos", 3, 3)
    weights = ["--weights", str(write_weights(tmp_path / "weights"))]
    made = ["reconstruct", str(tmp_path / "photos"), "-o", str(tmp_path / "a.ply"), "--preset", preset, *weights]
    assert run([*made, "--max-size", "128", "--tto", "0", "--depth", "-q"]) == ExitCode.DONE
    assert run(["inspect", str(tmp_path / "a"), "--query", "2", "-q", "--json"]) == ExitCode.DONE
    found = json.loads(capsys.readouterr().out)
    folder = tmp_path / "a-inspected"
    assert {path.name for path in folder.iterdir()} == {
        "attention_appearance.png",
        "attention_geometry.png",
        "histograms.png",
        "points.png",
        "query.png",
        *(["rounds.png"] if preset == "compact" else []),
    }
    # The memories of `compact` have no values before optimisation.
    warned = [f"the values of the {name} memory are all zero" for name in ("geometry", "appearance")]
    assert [text.split(":")[0] for text in found["warnings"]] == (warned if preset == "compact" else [])
    assert found["query"] == 2
    assert found["depth"] is True
    for shares in found["attention"].values():
        assert set(shares) == {"room3_0.png", "room3_1.png", "room3_2.png", "special"}
        assert sum(shares.values()) == pytest.approx(1, abs=1e-3)
    assert found["attention"]["appearance"]["special"] == 0
    assert set(found["rounds"]) == ({"geometry", "appearance"} if preset == "compact" else set())
    for shares in found["rounds"].values():
        assert set(shares) == {"room3_0.png", "room3_1.png", "room3_2.png", "nothing"}
        assert sum(shares.values()) == pytest.approx(1, abs=1e-3)
        assert 0 < shares["nothing"] < 1
    assert (found["attention"]["geometry"]["special"] > 0) == (preset == "official-8192")
    assert 0 < found["opacity"]["0"] <= found["opacity"]["1"] <= 1
    assert cv2.imread(str(folder / "attention_geometry.png")).shape[1] == 3 * canvas
    assert run(["inspect", str(tmp_path / "a"), "-q"]) == ExitCode.BAD_INPUT  # there already
    assert run(["inspect", str(tmp_path / "a"), "--query", "999999", "--force", "-q"]) == ExitCode.BAD_INPUT
    assert "there are queries 0 to" in capsys.readouterr().err
    assert (folder / "points.png").is_file()


def test_figures_are_those_of_gaussians_that_were_optimised_themselves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The memories decode to what they were before."""
    take_photos(tmp_path / "photos", 3, 3)
    made = ["reconstruct", str(tmp_path / "photos"), "-o", str(tmp_path / "a.ply"), "--max-size", "128", "-q"]
    assert run([*made, "--tto", "3", "--tto-space", "gaussians", "--quality", "draft"]) == ExitCode.DONE
    assert run(["info", str(tmp_path / "a"), "-q", "--json"]) == ExitCode.DONE
    of_the_file = json.loads(capsys.readouterr().out)["opacity"]["quantiles"]
    assert run(["inspect", str(tmp_path / "a"), "-q", "--json"]) == ExitCode.DONE
    found = json.loads(capsys.readouterr().out)
    assert found["opacity"] == pytest.approx(of_the_file, abs=1e-5)
    assert found["warnings"][0].startswith("the Gaussians were optimised themselves")
