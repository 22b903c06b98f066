"""The library prints nothing, takes text for paths, reports its progress, and refuses wrong settings."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import querysplat_cli as qs
from querysplat_cli.commands import library
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.progress import Stages


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    red = torch.tensor([[[1.7, -1.7, -1.7]]])
    turn = torch.tensor([[1.0, 0, 0, 0]])
    gaussians = qs.Gaussians(torch.tensor([[0.0, 0, 4]]), turn, torch.full((1, 3), 0.2), torch.tensor([0.9]), red)
    assert qs.write_ply(str(tmp_path / "one.ply"), gaussians) == 1
    return tmp_path / "one.ply"


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the pipeline is called with, in place of making a scene."""
    seen: list[Any] = []

    def stand_in(name: str) -> Callable[[Any, Stages], Any]:
        def run(settings: Any, stages: Stages) -> Any:
            seen.append(settings)
            with stages(name) as progress:
                progress("half", 0.5)
            views: dict[str, Any] = {"used": [], "left_out": []}
            return Report("made.ply", "made", views, 0, {}, {}, [], [], [], {}, 1.0, "a machine")

        return run

    monkeypatch.setattr(library, "make_scene", stand_in("cameras"))
    monkeypatch.setattr(library, "optimise_scene", stand_in("tto"))
    return seen


def test_settings_are_those_of_the_command_line(called: list[Any]) -> None:
    scene = qs.reconstruct("photos", "out/scene.ply", holdout_every=4, poses="transforms.json", prune="off", tto=None)
    assert scene.ply == Path("made.ply")
    qs.reconstruct([Path("a.png"), "b.png"])
    qs.optimise("scene", steps=3)
    qs.optimise(qs.Scene(Path("s.ply")), quality="high")
    assert called == [
        ReconstructSettings(
            (Path("photos"),), Path("out/scene.ply"), holdout_every=4, poses=Path("transforms.json"), prune="off"
        ),
        ReconstructSettings((Path("a.png"), Path("b.png"))),
        ResumeSettings(Path("scene"), steps=3),
        ResumeSettings(Path("s.ply"), quality="high"),
    ]


def test_progress_is_called_back(called: list[Any]) -> None:
    seen: list[tuple[str, str, float]] = []
    qs.reconstruct("photos", progress=lambda *step: seen.append(step))
    assert seen == [("cameras", "", 0.0), ("cameras", "half", 0.5), ("cameras", "", 1.0)]


@pytest.mark.parametrize(
    ("settings", "message", "hint"),
    [
        ({"holdout": 4}, "reconstruct has no setting 'holdout'", "Did you mean holdout_every?"),
        ({"zzz": 4}, "reconstruct has no setting 'zzz'", "The settings are: inputs, ply, holdout_every"),
        ({"holdout_every": 1}, "holdout_every cannot be 1", "at least 2"),
        ({"budget": 1e9}, "budget cannot be", "at most 1"),
        ({"prune": 0}, "prune cannot be 0", "at least 1"),
        ({"quality": "best"}, "quality cannot be 'best'", "'draft', 'standard', 'high' or 'max'"),
        ({"budget": "soon"}, "budget cannot be 'soon'", "number"),
        ({"max_size": float("nan")}, "max_size cannot be nan", "number"),
    ],
)
def test_wrong_settings_are_refused_in_two_lines(
    settings: dict[str, Any], message: str, hint: str, called: list[Any]
) -> None:
    with pytest.raises(qs.QuerySplatError, match=message) as error:
        qs.reconstruct("photos", **settings)
    assert hint in error.value.hint
    assert called == []


def test_a_file_of_any_program_is_a_scene(ply: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = qs.open_scene(str(ply))
    assert scene.report is None
    assert len(scene.gaussians) == 1
    assert scene.gaussians is scene.gaussians, "the file is read once"
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    cameras = qs.Cameras(torch.eye(4)[None], K, 48, 64)
    assert torch.equal(qs.render(scene, cameras).colour, qs.render(scene.gaussians, cameras).colour)
    assert qs.render(scene, cameras, background=torch.ones(3)).colour[0, :, 0, 0].tolist() == [1, 1, 1]
    with pytest.raises(qs.QuerySplatError, match=r"no cameras of its own: there is no .*cameras\.json"):
        scene.cameras  # noqa: B018 - the access is the test
    assert capfd.readouterr() == ("", "")


def test_a_file_may_have_any_unit(ply: Path) -> None:
    """Beyond the usual limit of depth, 125 units, the picture was black."""
    one = qs.read_ply(str(ply))
    qs.write_ply(str(ply), replace(one, means=100 * one.means, scales=100 * one.scales))
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    near = qs.Cameras(torch.eye(4)[None].double(), K.double(), 48, 64)
    torch.testing.assert_close(qs.render(ply, near).colour, qs.render(one, near).colour, atol=1e-4, rtol=0)


def test_gaussians_without_cameras_and_missing_scenes_are_refused(ply: Path) -> None:
    with pytest.raises(qs.QuerySplatError, match="no cameras of their own"):
        qs.render(qs.read_ply(str(ply)))
    with pytest.raises(qs.QuerySplatError, match="no such scene"):
        qs.open_scene(ply.parent / "nothing")
