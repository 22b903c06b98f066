"""What is written to a scene folder is read back unchanged."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.scene_folder import StoredScene, read_scene, write_scene
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.views import Views

HEIGHT, WIDTH = 24, 36


def views(names: tuple[str, ...], seed: int) -> tuple[Views, Cameras]:
    """Pictures of two sizes on one canvas, with colours that 8 bits hold exactly."""
    count = len(names)
    generator = torch.Generator().manual_seed(seed)
    sizes = tuple((HEIGHT, WIDTH - 12 * (i % 2)) for i in range(count))
    images, masks = torch.zeros(count, 3, HEIGHT, WIDTH), torch.zeros(count, HEIGHT, WIDTH, dtype=torch.bool)
    for i, (height, width) in enumerate(sizes):
        images[i, :, :height, :width] = torch.randint(0, 256, (3, height, width), generator=generator) / 255
        masks[i, :height, :width] = True
    masks[0, :2] = False
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, :3, 3] = torch.randn(count, 3, generator=generator)
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 41, HEIGHT / 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Views(images, masks, names, sizes), Cameras(w2c, K, HEIGHT, WIDTH)


@pytest.fixture
def stored() -> tuple[StoredScene, Gaussians]:
    inputs, cameras = views(("a.png", "sub/b.png", "c.webp"), 0)
    heldout = views(("d.png",), 1)
    depth = torch.full(inputs.masks.shape, 3.0)
    anchors, _ = build_anchors(inputs, cameras, Geometry(depth, torch.ones_like(depth), (), 6))
    generator = torch.Generator().manual_seed(2)
    memories = Memories(*(torch.randn(5 + i // 2, 2, 3, generator=generator) for i in range(4)))
    gaussians = Gaussians(
        torch.randn(7, 3, generator=generator) + torch.tensor([0.0, 0, 4]),
        torch.nn.functional.normalize(torch.randn(7, 4, generator=generator), dim=-1),
        torch.rand(7, 3, generator=generator) + 0.01,
        torch.rand(7, generator=generator) * 0.9 + 0.05,
        torch.randn(7, 4, 3, generator=generator),
    )
    lens = PhotoCamera(np.eye(4), (40.0, 41.0), (18.0, 12.0), (0.1, 0.0, 0.0, 0.0), HEIGHT, WIDTH)
    photos = {name: PhotoFile.of(name, Path("/photos") / name, lens) for name in ("a.png", "d.png")}
    exposures = Exposures(Exposures.identity(3).matrices * torch.tensor([0.9, 1.0, 1.1])[:, None, None])
    scene = StoredScene(inputs, cameras, heldout, memories, anchors, "compact", photos=photos, exposures=exposures)
    return scene, gaussians


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


def test_round_trip(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    scene, gaussians = stored
    assert write_scene(tmp_path / "s.ply", scene, gaussians, {"note": "é", "tto": []}) == 7
    for path in (tmp_path / "s.ply", tmp_path / "s"):
        found, report = read_scene(path)
        assert report == {"note": "é", "tto": []}
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
    assert len(read_ply(tmp_path / "s.ply")) == 7
    files = [tmp_path / "s.ply", *(path for path in (tmp_path / "s").rglob("*") if path.is_file())]
    assert len({file.stat().st_mode for file in files}) == 1  # the same permissions as any other file


def test_cameras_name_the_files_that_are_there(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    """c.webp is stored as a PNG. Other tools find it by `file_path`; cameras are also found by the photo's own name."""
    write_scene(tmp_path / "s.ply", *stored, {"tto": []})
    listing = tmp_path / "s" / "cameras.json"
    content = json.loads(listing.read_text())
    named = {frame["file_path"] for frame in [*content["frames"], *content["heldout_frames"]]}
    there = {str(path.relative_to(tmp_path / "s")) for path in (tmp_path / "s" / "images").rglob("*.*")}
    assert named == there
    assert list(read_transforms(listing)) == ["a.png", "b.png", "c.webp", "d.png"]
    (scene,) = find_scenes([tmp_path / "s"])  # how evaluate and train read it
    assert len(scene.frames) == 4


@pytest.mark.parametrize("part", ["cameras.json", "photos.json", "report.json", "memories.safetensors", "images/a.png"])
def test_a_damaged_folder_is_refused(part: str, stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    write_scene(tmp_path / "s.ply", *stored, {"note": "long enough to be torn", "tto": []})
    file = tmp_path / "s" / part
    file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(QuerySplatError):
        read_scene(tmp_path / "s")


def test_nothing_is_replaced_when_writing_fails(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, gaussians = stored
    write_scene(tmp_path / "s.ply", scene, gaussians, {"turn": 1, "tto": []})
    before = (tmp_path / "s.ply").read_bytes()

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["querysplat_cli.pipeline.scene_folder"], "write_preview", fail)
    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "s.ply", replace(scene, model="other"), gaussians[:3], {"turn": 2, "tto": []})
    assert (tmp_path / "s.ply").read_bytes() == before
    assert json.loads((tmp_path / "s" / "report.json").read_text()) == {"turn": 1, "tto": []}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s", "s.ply"]
