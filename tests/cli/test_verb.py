"""Verbs are made of dataclasses: each field is declared once, and its text becomes a value of its type."""

import inspect
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from typer.main import get_command

from querysplat_cli.cli.app import app
from querysplat_cli.cli.reconstruct import reconstruct
from querysplat_cli.cli.verb import verb
from querysplat_cli.commands.convert_request import Conversion
from querysplat_cli.commands.requests import PosesRequest, RenderRequest
from querysplat_cli.evaluation.generate import INTERVALS, SCALES
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import InputCount, Scale

COMMANDS = get_command(app).commands  # type: ignore[attr-defined]  # it is a group


def parsed(kind: type, *arguments: str) -> Any:
    """The object of `kind` that a verb with these arguments is called with."""
    seen = []

    def take(request: Any) -> None:
        seen.append(request)

    take.__annotations__["request"] = kind
    application = typer.Typer()
    application.command()(verb(take))
    application(list(arguments), standalone_mode=False)
    return seen[0]


def test_without_options_the_defaults_are_those_of_the_dataclass() -> None:
    scene = Path("a")
    assert parsed(ReconstructSettings, "a") == ReconstructSettings((scene,))
    assert parsed(ResumeSettings, "a") == ResumeSettings(scene)
    assert parsed(RenderRequest, "a") == RenderRequest(scene)
    assert parsed(PosesRequest, "a") == PosesRequest(scene)
    assert parsed(Conversion, "a", "b") == Conversion(scene, Path("b"))
    assert parsed(EvalRequest, "a") == EvalRequest((scene,))


def test_options_of_every_type() -> None:
    arguments = ["a", "b", "--tto", "7", "--prune", "900", "--max-size=auto", "--no-refine-cameras", "--budget", "2.5"]
    settings = parsed(ReconstructSettings, *arguments, "--depth", "--tto-space", "both", "--poses", "c", "-o", "d.ply")
    assert settings == ReconstructSettings(
        (Path("a"), Path("b")), Path("d.ply"), tto=7, prune=900, refine_cameras=False, budget=2.5, depth=True,
        tto_space="both", poses=Path("c"),
    )  # fmt: skip
    request = parsed(RenderRequest, "a", "--size", "40x30", "--background", "1,0.5,0")
    assert request == RenderRequest(Path("a"), size=(30, 40), background=(1.0, 0.5, 0.0))


def test_an_evaluation_takes_options_of_reconstruct() -> None:
    arguments = ["a", "--views", "4, 2,4", "--tto", "auto,3", "--preset", "p", "--shard", "2/8", "--cameras", "posed"]
    request = parsed(EvalRequest, *arguments, "--splits", "s", "--splits", "t")
    settings = replace(EvalRequest(()).settings, preset="p")
    assert request == EvalRequest(
        (Path("a"),), views=(4, 2), tto=(None, 3), settings=settings, shard=(2, 8), cameras=("posed",),
        splits=(Path("s"), Path("t")),
    )  # fmt: skip
    assert request.axes == (("tto", (None, 3)),)
    swept = parsed(EvalRequest, "a", "--sweep", "queries=auto,500", "--sweep", "tto=1")
    assert swept.axes == (("queries", (None, 500)), ("tto", (1,)))


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (ReconstructSettings, ["a", "--tto", "-1"]),
        (ReconstructSettings, ["a", "--tto", "1.5"]),
        (ReconstructSettings, ["a", "--prune", "0"]),
        (ReconstructSettings, ["a", "--prune", "some"]),
        (ReconstructSettings, ["a", "--max-size", "95"]),
        (ReconstructSettings, ["a", "--holdout-every", "1"]),
        (ReconstructSettings, ["a", "--fit", "stretch"]),
        (ReconstructSettings, ["a", "--budget", "0.5"]),
        (ReconstructSettings, []),
        (ReconstructSettings, [""]),
        (ReconstructSettings, ["a\udce4"]),
        (ResumeSettings, ["a", "--lr", "0"]),
        (Conversion, ["a", "b", "--scale", "0"]),
        (EvalRequest, ["a", "--views", "3"]),
        (EvalRequest, ["a", "--scales", "small,huge"]),
        (EvalRequest, ["a", "--tto", "1,-1"]),
    ],
)
def test_values_out_of_range_are_refused(kind: type, arguments: list[str]) -> None:
    with pytest.raises(typer.TyperException):
        parsed(kind, *arguments)


def test_a_wrong_number_is_answered_with_the_words_that_are_allowed() -> None:
    with pytest.raises(typer.BadParameter, match=r"'many'.*auto") as error:
        parsed(ReconstructSettings, "a", "--tto", "many")
    assert "--tto" in error.value.format_message()


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_option_has_one_sentence_of_help_at_least(name: str) -> None:
    for param in COMMANDS[name].params:
        text = param.help  # type: ignore[attr-defined]
        assert text, param.name
        assert text[0].isupper(), text
        assert text.endswith("."), text


def test_every_field_of_the_settings_is_an_option_of_reconstruct() -> None:
    options = inspect.signature(verb(reconstruct)).parameters.keys()
    assert {field.name for field in fields(ReconstructSettings)} < options


def test_generated_splits_offer_what_can_be_generated() -> None:
    assert get_args(InputCount) == tuple(INTERVALS)
    assert get_args(Scale) == SCALES
