"""The photos of the demo, and what a demo over a demo leaves."""

import errno
import os
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from querysplat_cli.commands import demo
from querysplat_cli.commands.demo import copy_shipped_photos, run_demo
from querysplat_cli.commands.requests import DemoRequest
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.photos import WHOLE, load_photo
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room


def test_shipped_photos_are_those_of_the_ray_caster(tmp_path: Path) -> None:
    """But for what JPEG loses: 2.2 grey levels."""
    copy_shipped_photos(tmp_path)
    scene = make_room(DemoRequest.seed)
    cameras = walk(scene, DemoRequest.photos, DemoRequest.seed)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [f"photo_{number + 1:02d}.jpg" for number in range(DemoRequest.photos)]
    for number in (0, DemoRequest.photos - 1):
        photo = load_photo(tmp_path / names[number], names[number], WHOLE)
        assert isinstance(photo, Photo)
        taken = 255 * cast(scene, cameras[[number]])[0][0].permute(1, 2, 0).clamp(0, 1).numpy()
        assert np.abs(photo.pixels - taken).mean() < 3


@pytest.mark.parametrize("end", [KeyboardInterrupt, RuntimeError])
def test_a_demo_that_ends_early_leaves_the_photos_of_the_last_one(
    end: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """New photos do not fit the old scene."""
    photos, seen = tmp_path / "photos", []
    photos.mkdir()
    (photos / "photo_01.jpg").write_bytes(b"mine")

    def ended(*_: object) -> None:
        seen.append(len(list(photos.iterdir())))
        raise end

    monkeypatch.setattr(demo, "reconstruct", ended)
    with pytest.raises(end):
        run_demo(DemoRequest(output=tmp_path, force=True), Stages())
    assert seen == [DemoRequest.photos]
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]
    assert [path.read_bytes() for path in photos.iterdir()] == [b"mine"]


def test_a_demo_replaces_photos_when_it_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photos").mkdir()
    for name in ("photo_99.jpg", "photo_1000.jpg", "photo_10000.jpg"):
        (tmp_path / "photos" / name).touch()
    monkeypatch.setattr(demo, "reconstruct", lambda *_: Mock(spec=Report))
    run_demo(DemoRequest(output=tmp_path, force=True), Stages())
    assert len(list((tmp_path / "photos").iterdir())) == DemoRequest.photos
    assert not (tmp_path / "photos/photo_99.jpg").exists()


def test_a_demo_without_room_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(demo, "copy_shipped_photos", full)
    with pytest.raises(QuerySplatError, match="disk is full"):
        run_demo(DemoRequest(output=tmp_path / "new" / "out"), Stages())
    assert list(tmp_path.iterdir()) == []
