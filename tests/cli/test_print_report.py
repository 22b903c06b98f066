"""What people read after `reconstruct` and `tto`."""

import os
import signal
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from querysplat_cli.cli import run
from querysplat_cli.cli.print_report import exit_if_interrupted, lines, print_report
from querysplat_cli.cli.verb import Printing
from querysplat_cli.cli.words import left_out
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.errors import QuerySplatError

REPORT = Report(
    ply="s.ply", scene="s", views={"used": ["a.png", "b.png"], "left_out": []}, gaussians=12345,
    seconds={"photos": 0.1, "cameras": 3.0, "depth": 2.0, "tto": 9.0, "total": 14.1},
    quality={"input": {"psnr": 24.0, "ssim": 0.7}, "heldout": None}, left_out=[], warnings=[],
    tto=[{"interrupted": False}], settings={}, peak_memory_gib=0.5, machine="a machine",
)  # fmt: skip


def test_what_how_good_how_long_where_and_what_next() -> None:
    said = list(lines(REPORT))
    assert len(said) == 5
    assert said[0] == "12,345 Gaussians from 2 photos"
    assert said[1] == "PSNR 24.00 dB, SSIM 0.700 on the photos"
    assert said[2] == "14.1 s (tto 9.0 s, cameras 3.0 s, depth 2.0 s), at most 0.50 GiB of memory"
    assert said[3].startswith("s.ply; s/preview.png")
    assert "querysplat tto s" in said[4]


@pytest.mark.parametrize(
    ("level", "further"),
    [
        ("standard", ", or querysplat tto s --quality high for a better scene"),
        ("high", ", or querysplat tto s --quality max for a better scene"),
        ("max", ""),
    ],
)
def test_a_scene_of_large_photos_is_not_sent_back_to_small_pictures(level: str, further: str) -> None:
    quality = {**REPORT.quality, "full_size": {"max_size": 900, "input": {"psnr": 30.0, "ssim": 0.9}, "heldout": None}}
    *_, last = lines(replace(REPORT, quality=quality, full_size={"level": level}))
    assert last == f"next: querysplat view s.ply{further}"


@pytest.mark.parametrize(
    ("run", "told"),
    [
        ({"loss_after": 0.07, "curve": [[0, 0.1, 0.07, 23.0, 9]]}, True),
        ({"loss_after": 0.06, "curve": [[0, 0.1, 0.07, 23.0, 9]]}, False),
        ({"loss_after": 0.07, "curve": []}, False),
    ],
)
def test_steps_that_were_not_kept_are_told(run: dict[str, Any], told: bool) -> None:
    said = list(lines(replace(REPORT, tto=[{"interrupted": False, "loss_before": 0.07, **run}])))
    assert any("were not kept" in line for line in said) == told


def test_the_next_command_can_be_copied_where_names_have_spaces() -> None:
    *_, last = lines(replace(REPORT, ply="my room/s.ply", scene="my room/s"))
    assert "querysplat view 'my room/s.ply', or querysplat tto 'my room/s' for" in last


def test_the_next_command_can_be_copied_where_names_begin_with_a_dash() -> None:
    *_, last = lines(replace(REPORT, ply="-s.ply", scene="-s"))
    assert "querysplat view ./-s.ply, or querysplat tto ./-s for" in last


def test_the_file_has_a_size_and_a_cost() -> None:
    lost = {"what": "precision", "psnr_lost": 0.031}
    said = list(lines(replace(REPORT, ply="s.spz", bytes=3 * 2**19, left_out=[lost])))
    assert said[3].startswith("s.spz (1.50 MiB, 0.03 dB lost by it); s/preview.png")


def test_left_out_photos_take_one_line_and_each_warning_one() -> None:
    left_out = [{"name": f"{i}.png", "why": "it is blurred"} for i in range(9)]
    report = replace(REPORT, views={"used": ["a.png"], "left_out": left_out}, warnings=["it is dark"])
    said = list(lines(report))
    assert said[:3] == [
        "12,345 Gaussians from 1 photo", "left out: 0.png (it is blurred), and 8 more", "warning: it is dark",
    ]  # fmt: skip
    assert len(said) == 7


def test_one_photo_is_named_for_each_reason() -> None:
    """A file of another kind came first, and hid why photos were left out."""
    reasons = ["not a picture"] * 2 + ["it is blurred", "not a picture", "it shows another place", "it is dark"]
    photos = [{"name": f"{number}.jpg", "why": why} for number, why in enumerate(reasons)]
    said = "left out: 0.jpg (not a picture), 2.jpg (it is blurred), 4.jpg (it shows another place), and 3 more"
    assert list(left_out(photos)) == [said]


def test_before_and_after() -> None:
    heldout = {"psnr": 20.0, "ssim": 0.6}
    quality = {**REPORT.quality, "heldout": heldout, "before": {"input": 23.0, "heldout": None}}
    quality["full_size"] = {"max_size": 1600, "input": {"psnr": 26.0, "ssim": 0.8}, "heldout": None}
    said = list(lines(replace(REPORT, quality=quality)))
    assert said[1] == (
        "PSNR 23.00 → 24.00 dB, SSIM 0.700 on the photos; PSNR 26.00 dB, SSIM 0.800 on the photos at 1600 px; "
        "PSNR 20.00 dB, SSIM 0.600 on held-out photos"
    )


@pytest.mark.parametrize("corrected", [True, False])
def test_scores_without_exposure_stand_beside_the_plain_ones_where_exposures_differ(corrected: bool) -> None:
    """A good scene of bracketed photos has 16 dB, because no render has the exposure of its photo."""
    quality = {**REPORT.quality, "input": {"psnr": 16.32, "ssim": 0.7, "psnr_cc": 27.54}}
    said = list(lines(replace(REPORT, quality=quality, exposure={"disagreement": 0.3, "corrected": corrected})))
    beside = " (27.54 colour-corrected)" if corrected else ""
    assert said[1] == f"PSNR 16.32 dB{beside}, SSIM 0.700 on the photos"


def test_a_stage_that_was_not_kept_has_a_line() -> None:
    stages = {"level": "high", "ended": "every planned step was taken", "not_kept": [1600]}
    said = list(lines(replace(REPORT, full_size=stages)))
    assert said[1] == "optimisation on photos of 1,600 px made them look worse, and was not kept"
    assert len(list(lines(replace(REPORT, full_size={**stages, "not_kept": []})))) == 5


def test_what_comes_next_after_an_optimisation_that_gained_nothing() -> None:
    matching = {"pairs": 3, "matcher": None}
    worse = {**REPORT.quality, "before": {"input": 24.5, "heldout": None}}
    said = list(lines(replace(REPORT, quality=worse, matching=matching)))
    assert said[-1] == "next: querysplat view s.ply"
    assert not any("SIFT" in line for line in said)  # that was said when the scene was made
    assert any("SIFT" in line for line in lines(replace(REPORT, matching=matching)))


def test_a_shell_in_the_folder_that_was_replaced_enters_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert list(lines(REPORT))[-1].startswith("next: querysplat view s.ply")
    folder.rmdir()
    assert list(lines(REPORT))[-1].startswith("next: cd . && querysplat view s.ply")
    os.chdir(tmp_path)


def test_names_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """rich would take [/b] for the end of bold text, and fail."""
    left_out = [{"name": "[/b][red].png", "why": "it is blurred"}]
    print_report(replace(REPORT, ply="[bold].ply", views={"used": [], "left_out": left_out}), Printing())
    said = capsys.readouterr().err
    assert "[/b][red].png" in said
    assert "[bold].ply" in said


def test_a_scene_that_was_saved_after_an_interruption_is_not_called_lost() -> None:
    exit_if_interrupted(REPORT)
    with pytest.raises(QuerySplatError, match="stopped early") as caught:
        exit_if_interrupted(replace(REPORT, tto=[{"interrupted": True}]))
    assert (caught.value.code, caught.value.hint) == (130, "The scene has what the optimisation had reached.")


def test_what_a_command_says_of_an_interruption_is_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`demo` saves what Ctrl-C left of its scene, and once ended with 0 then."""

    def interrupted(*arguments: object) -> Report:
        with suppress(KeyboardInterrupt):
            signals.interrupt(signal.SIGTERM)
        return replace(REPORT, tto=[{"interrupted": True}])

    monkeypatch.setattr("querysplat_cli.commands.demo.run_demo", interrupted)
    monkeypatch.setattr("querysplat_cli.cli.print_report.print_report", lambda *_: None)
    monkeypatch.setattr(signals._State, "received", None)
    assert run(["demo", "-q"]) == 143
    assert "The scene has what the optimisation had reached." in capsys.readouterr().err
