"""What a long run keeps is used again only where it was made of the same photos and settings."""

import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.pipeline.unfinished import OF_FILES, is_long, unfinished
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Photo

PART = Gaussians(*(torch.zeros(2, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
"""Stands for the cameras. Any part that can be kept does."""


class Stopped(Exception):
    """In place of a kill."""


@pytest.fixture
def settings(tmp_path: Path) -> ReconstructSettings:
    """Of a run with one photo that was stopped when its cameras and one of two regions were done."""
    (tmp_path / "a.jpg").write_bytes(b"a photo")
    found = ReconstructSettings((tmp_path,), tmp_path / "scene.ply", regions=2)
    with suppress(Stopped), unfinished(found, [photo(tmp_path)], 64) as work:
        assert work.notes == ()
        work.cameras(lambda: PART)
        (work.region(1) / "scene.pt").write_bytes(b"a region")
        work.region(2)
        raise Stopped
    return found


def photo(folder: Path) -> Photo:
    return Photo("a", folder / "a.jpg", np.zeros((4, 4, 3), np.uint8))


def goes_on(settings: ReconstructSettings, size: int = 64, *, regions: bool = True) -> tuple[bool, bool, str]:
    """Whether a run with these settings takes the cameras, whether it takes the region, and what the user reads."""
    made_again = []
    folder = settings.inputs[0]
    with suppress(Stopped), unfinished(settings, [photo(folder)], size) as work:
        work.cameras(lambda: made_again.append("cameras") or PART)
        region = regions and (work.region(1) / "scene.pt").is_file()
        raise Stopped
    return not made_again, region, " ".join(work.notes)


def test_the_same_settings_go_on(settings: ReconstructSettings) -> None:
    assert goes_on(settings) == (True, True, "went on with the cameras and 1 region of an unfinished run")


@pytest.mark.parametrize(("more", "said"), [([], "cameras of an"), ([2], "cameras and 2 regions of an")])
def test_what_is_done_is_said(settings: ReconstructSettings, more: list[int], said: str) -> None:
    folder = settings.inputs[0] / ".scene.ply.unfinished"
    for number in more:
        (folder / f"region-{number}" / "scene.pt").write_bytes(b"a region")
    if not more:
        (folder / "region-1" / "scene.pt").unlink()
    assert said in goes_on(settings)[2]


def test_what_only_changes_the_files_goes_on(settings: ReconstructSettings) -> None:
    """Replacing, frame and engine may change."""
    changed = replace(settings, force=True, frame="vgm", cluster="local:2", backdrop=False)
    assert {"force", "frame", "cluster", "backdrop"} < set(OF_FILES)
    assert goes_on(changed)[:2] == (True, True)


@pytest.mark.parametrize(
    ("change", "option"),
    [({"quality": "draft"}, "--quality"), ({"queries": 50}, "--queries"), ({"regions": 3}, "--regions")],
)
def test_a_setting_of_regions_invalidates_these_alone(
    settings: ReconstructSettings, change: dict[str, object], option: str
) -> None:
    cameras, region, said = goes_on(replace(settings, **change))
    assert (cameras, region) == (True, False)
    assert said == f"an unfinished run had other values of {option}: its regions are made again"
    assert goes_on(replace(settings, **change))[0]  # the new values are those that count from now on


def test_a_setting_of_cameras_invalidates_both(settings: ReconstructSettings) -> None:
    assert goes_on(replace(settings, seed=7, max_views=9)) == (
        False,
        False,
        "an unfinished run had other values of --max-views, --seed: its cameras and regions are made again",
    )


def test_another_photo_or_size_invalidates_both(settings: ReconstructSettings) -> None:
    (settings.inputs[0] / "a.jpg").write_bytes(b"another photo")
    cameras, region, said = goes_on(settings)
    assert (cameras, region) == (False, False)
    assert "photos" in said
    assert goes_on(settings, size=32)[:2] == (False, False)


def test_a_new_mask_invalidates_both(settings: ReconstructSettings) -> None:
    (settings.inputs[0] / "masks").mkdir()
    (settings.inputs[0] / "masks" / "a.jpg.png").write_bytes(b"a mask")
    cameras, region, said = goes_on(settings)
    assert (cameras, region) == (False, False)
    assert "other values of masks" in said


def test_another_model_in_the_folder_of_poses_invalidates_both(settings: ReconstructSettings) -> None:
    model = settings.inputs[0] / "model"
    model.mkdir()
    for name in ("cameras.bin", "images.bin"):
        (model / name).write_bytes(b"a model")
    posed = replace(settings, poses=model)
    goes_on(posed)
    assert goes_on(posed)[0]
    (model / "images.bin").write_bytes(b"another model")
    cameras, _, said = goes_on(posed)
    assert not cameras
    assert "other values of the files of --poses" in said


def test_a_kill_while_old_stages_are_removed_keeps_none_as_new(
    settings: ReconstructSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(folder: Path) -> None:
        raise Stopped

    changed = replace(settings, quality="draft")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed)
        with suppress(Stopped), unfinished(changed, [photo(settings.inputs[0])], 64):
            pass
    assert goes_on(changed)[:2] == (True, False)


def test_nothing_is_said_of_regions_where_there_are_none(settings: ReconstructSettings) -> None:
    for number in (1, 2):
        shutil.rmtree(settings.inputs[0] / ".scene.ply.unfinished" / f"region-{number}")
    kept = "went on with the cameras of an unfinished run"
    assert goes_on(replace(settings, tto=7), regions=False) == (True, False, kept)
    again = "an unfinished run had other values of --seed: its cameras are made again"
    assert goes_on(replace(settings, tto=7, seed=7), regions=False) == (False, False, again)


@pytest.mark.parametrize("damage", ["cut off", "[]", None])
def test_cameras_of_unknown_settings_are_made_again(settings: ReconstructSettings, damage: str | None) -> None:
    made_of = settings.inputs[0] / ".scene.ply.unfinished" / "made_of.json"
    made_of.write_text(damage) if damage else made_of.unlink()
    cameras, region, said = goes_on(settings)
    assert (cameras, region) == (False, False)
    assert said == "what an unfinished run was made of is not known: its cameras and regions are made again"


def test_what_a_stopped_run_keeps_is_noted(settings: ReconstructSettings) -> None:
    signals.keep("")
    goes_on(settings)
    folder = settings.inputs[0] / ".scene.ply.unfinished"
    assert signals.kept() == f"What is finished is kept in {folder}, and the same command goes on with it."


def test_a_run_that_ends_leaves_nothing(settings: ReconstructSettings) -> None:
    folder = settings.inputs[0] / ".scene.ply.unfinished"
    assert folder.is_dir()
    with unfinished(settings, [photo(settings.inputs[0])], 64):
        pass
    assert not folder.exists()


def test_a_short_run_goes_on_with_what_a_long_one_left(settings: ReconstructSettings) -> None:
    """With fewer regions the folder was neither used nor ever removed."""
    alone = replace(settings, regions=1)
    assert is_long(alone, photos=12)
    assert goes_on(alone, regions=False)[0]
    with unfinished(alone, [photo(settings.inputs[0])], 64):
        pass
    assert not is_long(alone, photos=12)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no error of its own for long names")
def test_a_name_that_leaves_no_room_for_the_folder_is_refused_at_once(tmp_path: Path) -> None:
    settings = ReconstructSettings((tmp_path / "no photos",), tmp_path / "new" / f"{'a' * 240}.ply")
    with pytest.raises(QuerySplatError, match="the name of the output is too long"):
        reconstruct(settings)
    assert not (tmp_path / "new").exists()


def test_a_run_that_is_refused_removes_nothing_of_the_other_one(tmp_path: Path) -> None:
    """It removed the folder in which another process had not kept its cameras yet."""
    (tmp_path / "a.jpg").write_bytes(b"a photo")
    settings = ReconstructSettings((tmp_path,), tmp_path / "scene.ply", regions=2)
    with unfinished(settings, [photo(tmp_path)], 64) as work:
        with pytest.raises(QuerySplatError, match="another process"), unfinished(settings, [photo(tmp_path)], 64):
            pytest.fail("two runs have one folder")
        assert work.folder.is_dir()
