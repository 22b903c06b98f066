"""What is written to a scene folder is read back unchanged."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from stored_scene import a_report

from querysplat_cli.commands.viewed_scene import viewed_scene
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.scene_folder import StoredScene, write_images, write_scene
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import stored_names, write_picture


def equal(one: object, two: object) -> None:
    assert one.__dict__.keys() == two.__dict__.keys()
    for name, value in one.__dict__.items():
        other = getattr(two, name)
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(other, value, atol=1e-6, rtol=1e-6)
        elif hasattr(value, "__dict__"):
            equal(value, other)
        else:
            assert other == value


@pytest.mark.parametrize("name", ["{}/a.png", "../a.png", "sub/../../a.png"])
def test_no_picture_is_written_outside_its_folder(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path, name: str
) -> None:
    views = replace(stored[0].views, names=(name.format(tmp_path), "b.png", "c.png"))
    with pytest.raises(QuerySplatError, match="outside the scene's folder"):
        write_images(tmp_path / "images", views, stored_names(views.names), tmp_path)
    assert not (tmp_path / "a.png").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no error of its own for long names")
def test_a_photo_whose_picture_can_have_no_name_is_refused_at_once(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write_picture(photos / "a.webp", np.zeros((64, 64, 3), np.uint8))
    (photos / "a.webp").rename(photos / f"{'a' * 248}.webp")
    with pytest.raises(QuerySplatError, match="too long for its picture"):
        reconstruct(ReconstructSettings((photos,), tmp_path / "scene.ply"))
    assert list(tmp_path.iterdir()) == [photos]


def test_a_picture_that_is_stored_loses_nothing_more(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    """Every `tto` wrote the photos of a scene as JPEG anew."""
    scene = stored[0]
    noise = torch.rand(scene.views.images.shape, generator=torch.Generator().manual_seed(0))
    views = replace(scene.views, images=noise, names=("a.jpg", "b.png", "c.jpg"))
    files = stored_names(views.names)
    write_images(tmp_path / "first", views, files, tmp_path / "nothing")
    found = [cv2.imread(str(tmp_path / "first" / name)) for name in views.names]
    images = torch.zeros_like(noise)
    for row, (pixels, (height, width)) in enumerate(zip(found, views.sizes, strict=True)):
        images[row, :, :height, :width] = torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1) / 255
    write_images(tmp_path / "second", replace(views, images=images), files, tmp_path / "first")
    for name in views.names:
        assert (tmp_path / "second" / name).read_bytes() == (tmp_path / "first" / name).read_bytes()
    images[0] = 1 - images[0]
    write_images(tmp_path / "other", replace(views, images=images), files, tmp_path / "first")
    assert (tmp_path / "other" / "a.jpg").read_bytes() != (tmp_path / "first" / "a.jpg").read_bytes()


def test_round_trip(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    scene, gaussians = stored
    assert write_scene(tmp_path / "s.ply", scene, gaussians, a_report(machine="é")) == 7
    for path in (tmp_path / "s.ply", tmp_path / "s"):
        found, report = read_scene(path)
        assert report == a_report(machine="é", gaussians=7, bytes=(tmp_path / "s.ply").stat().st_size)
        assert scene.heldout is not None
        assert found.heldout is not None
        equal(scene.views, found.views)
        equal(scene.cameras, found.cameras)
        equal(scene.heldout[0], found.heldout[0])
        equal(scene.heldout[1], found.heldout[1])
        equal(scene.memories, found.memories)
        equal(scene.anchors, found.anchors)
        assert found.model == "compact"
        assert found.photos == scene.photos
        equal(scene.points, found.points)
    assert len(read_ply(tmp_path / "s.ply")) == 7
    files = [tmp_path / "s.ply", *(path for path in (tmp_path / "s").rglob("*") if path.is_file())]
    assert len({file.stat().st_mode for file in files}) == 1  # the same permissions as any other file


def test_cameras_name_the_files_that_are_there(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    """c.webp is stored as a PNG. Other tools find it by `file_path`; cameras are also found by the photo's own name."""
    write_scene(tmp_path / "s.ply", *stored, a_report())
    listing = tmp_path / "s" / "cameras.json"
    content = json.loads(listing.read_text())
    named = {frame["file_path"] for frame in [*content["frames"], *content["heldout_frames"]]}
    there = {str(path.relative_to(tmp_path / "s")) for path in (tmp_path / "s" / "images").rglob("*.*")}
    assert named == there
    assert list(read_transforms(listing)) == ["a.png", "b.png", "c.webp", "d.png"]
    (scene,) = find_scenes([tmp_path / "s"])  # how evaluate and train read it
    assert len(scene.frames) == 4


def test_photos_whose_names_differ_by_a_second_suffix_have_pictures_of_their_own(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    """The picture of a.webp is called as the photo a.webp.png is, so one replaced the other."""
    scene = stored[0]
    assert scene.heldout is not None
    names = ("a.webp", "a.webp.png.png", "a")
    held = replace(scene.heldout[0], names=("a.webp.png",))
    scene = replace(scene, views=replace(scene.views, names=names), heldout=(held, scene.heldout[1]), points=None)
    scene = replace(scene, photos={})
    write_scene(tmp_path / "s.ply", scene, stored[1], a_report())
    found, _ = read_scene(tmp_path / "s")
    assert found.heldout is not None
    equal(found.views, scene.views)
    equal(found.heldout[0], held)
    shown = viewed_scene(tmp_path / "s")
    files = ["a.webp.png.png.png", "a.webp.png.png", "a.png", "a.webp.png"]
    assert [path.name for path in shown.photos.values()] == files


@pytest.mark.parametrize(
    "part", ["cameras.json", "photos.json", "points.safetensors", "report.json", "memories.safetensors", "images/a.png"]
)
def test_a_damaged_folder_is_refused(part: str, stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    write_scene(tmp_path / "s.ply", *stored, a_report())
    file = tmp_path / "s" / part
    file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(QuerySplatError):
        read_scene(tmp_path / "s")


def test_nothing_is_replaced_when_writing_fails(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, gaussians = stored
    write_scene(tmp_path / "s.ply", scene, gaussians, a_report(gaussians=1))
    before = (tmp_path / "s.ply").read_bytes()
    report = (tmp_path / "s" / "report.json").read_bytes()

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["querysplat_cli.pipeline.scene_folder"], "write_preview", fail)
    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "s.ply", replace(scene, model="other"), gaussians[:3], a_report(gaussians=2))
    assert (tmp_path / "s.ply").read_bytes() == before
    assert (tmp_path / "s" / "report.json").read_bytes() == report
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s", "s.ply"]
