"""What is written to a scene folder is read back unchanged."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.config import preset
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.read_scene import check_model, read_scene
from querysplat_cli.pipeline.scene_folder import StoredScene, write_scene
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.sparse_points import SparsePoints
from querysplat_cli.scene.views import PhotoSource, Views

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
    geometry, appearance = (1 + int(near.index.max()) for near in (anchors.geometry, anchors.appearance))
    rows = (geometry, geometry, appearance + 1, appearance + 1)
    memories = Memories(*(torch.randn(count, 2, 3, generator=generator) for count in rows))
    gaussians = Gaussians(
        torch.randn(7, 3, generator=generator) + torch.tensor([0.0, 0, 4]),
        torch.nn.functional.normalize(torch.randn(7, 4, generator=generator), dim=-1),
        torch.rand(7, 3, generator=generator) + 0.01,
        torch.rand(7, generator=generator) * 0.9 + 0.05,
        torch.randn(7, 4, 3, generator=generator),
    )
    lens = PhotoCamera(np.eye(4), (40.0, 41.0), (18.0, 12.0), (0.1, 0.0, 0.0, 0.0), HEIGHT, WIDTH)
    photos = {name: PhotoFile.of(name, PhotoSource(Path("/photos") / name), lens) for name in ("a.png", "d.png")}
    exposures = Exposures(Exposures.identity(3).matrices * torch.tensor([0.9, 1.0, 1.1])[:, None, None])
    scene = StoredScene(inputs, cameras, heldout, memories, anchors, "compact", photos=photos, exposures=exposures)
    points = SparsePoints(
        torch.rand(2, 3), torch.zeros(2, 3).byte(), torch.zeros(2).int(), torch.arange(2).int(), torch.rand(2, 2)
    )
    return replace(scene, points=points), gaussians


def a_report(**changes: Any) -> dict[str, Any]:
    """A report with every entry that a later run reads."""
    run = {
        "space": "features", "steps": 3, "seconds": None, "loss_before": 0.2, "loss_after": 0.1, "cameras": None,
        "added": 0, "undone": 0, "interrupted": False, "curve": [],
    }  # fmt: skip
    settings = {"queries": None, "weights": None, "precision": "fp32"}
    report = Report(
        ply="s.ply", scene="s", views={"used": ["a.png"], "left_out": [{"name": "x.png", "why": "it is empty"}]},
        gaussians=7, seconds={"total": 1.0}, quality={}, left_out=[], warnings=[], tto=[run], settings=settings,
        peak_memory_gib=0.5, machine="a machine",
    )  # fmt: skip
    return {**report.as_dict(), **changes}


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
    assert write_scene(tmp_path / "s.ply", scene, gaussians, a_report(machine="é")) == 7
    for path in (tmp_path / "s.ply", tmp_path / "s"):
        found, report = read_scene(path)
        assert report == a_report(machine="é", bytes=(tmp_path / "s.ply").stat().st_size)
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


Tensors = dict[str, torch.Tensor]


def change(name: str, how: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Tensors], Tensors]:
    return lambda tensors: {**tensors, name: how(tensors[name])}


def with_nan(tensor: torch.Tensor) -> torch.Tensor:
    tensor = tensor.clone()
    tensor.view(-1)[0] = torch.nan
    return tensor


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("memories.geometry_values", change("memories.geometry_values", lambda t: t[: len(t) // 2])),
        ("memories.geometry_values", change("memories.geometry_values", lambda t: t[..., 0].contiguous())),
        ("memories.geometry_keys", change("memories.geometry_keys", with_nan)),
        ("memories.appearance_keys", change("memories.appearance_keys", torch.Tensor.long)),
        ("anchors.geometry.index", change("anchors.geometry.index", lambda t: t + 10**6)),
        ("anchors.appearance.index", change("anchors.appearance.index", lambda t: t - 10**6)),
        ("anchors.queries.index", change("anchors.queries.index", torch.Tensor.float)),
        ("anchors.queries", change("anchors.queries.index", lambda t: t[1:])),
        ("anchors.geometry.index", change("anchors.geometry.index", torch.Tensor.int)),
        ("anchors.scales", change("anchors.scales", torch.Tensor.neg)),
        ("anchors.opacities", change("anchors.opacities", lambda t: t + 1)),
        ("anchors.spacing", lambda tensors: {k: v for k, v in tensors.items() if k != "anchors.spacing"}),
        ("masks", change("masks", lambda t: t[:-1])),
        ("masks", change("masks", torch.Tensor.float)),
        ("mask of", change("masks", torch.ones_like)),
        ("kept", lambda tensors: {**tensors, "kept": torch.ones(3, dtype=torch.bool)}),
    ],
)  # fmt: skip
def test_tensors_that_do_not_fit_are_refused_by_name(
    name: str, damage: Callable[[Tensors], Tensors], stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    write_scene(tmp_path / "s.ply", *stored, a_report())
    file = tmp_path / "s" / "memories.safetensors"
    save_file(damage(load_file(file)), file, metadata={"model": "compact"})
    with pytest.raises(QuerySplatError, match=name):
        read_scene(tmp_path / "s")


def test_a_scene_with_colours_above_white_by_rounding_is_read(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    scene, gaussians = stored
    white = replace(scene.anchors, colours=torch.full_like(scene.anchors.colours, 1.0000002))
    write_scene(tmp_path / "s.ply", replace(scene, anchors=white), gaussians, a_report())
    assert read_scene(tmp_path / "s")[0].anchors.colours.equal(white.colours)


def test_a_map_that_names_rows_that_are_not_there_is_refused(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    scene, gaussians = stored
    counts = len(scene.memories.geometry_keys), len(scene.memories.appearance_keys)
    where = MemoryMap(*(torch.arange(n).int() for n in counts), torch.tensor([0, 4, 6]).int(), torch.zeros(0, 0, 0))
    write_scene(tmp_path / "s.ply", replace(scene, map=where), gaussians, a_report())
    assert read_scene(tmp_path / "s")[0].map is not None
    for wrong in (
        replace(where, geometry_rows=where.geometry_rows + 1000),
        replace(where, appearance_rows=where.appearance_rows[:-1]),
        replace(where, grid=torch.tensor([-1, 4, 6]).int()),
        replace(where, depth=torch.zeros(1, 2, 3)),
    ):
        write_scene(tmp_path / "s.ply", replace(scene, map=wrong), gaussians, a_report())
        with pytest.raises(QuerySplatError, match=r"map\."):
            read_scene(tmp_path / "s")


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": None}, {"settings": {}}, {"settings": {"queries": "x", "weights": None, "precision": "fp32"}},
        {"tto": 3}, {"tto": [{"space": "features"}]}, {"gaussians": "7"}, {"gaussians": -1}, {"views": []},
        {"left_out": [{"what": 1}]}, {"more": 1}, {"full_size": {}}, {"seconds": {"total": "long"}},
    ],
)  # fmt: skip
def test_a_report_of_other_types_is_refused(
    changes: dict[str, Any], stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    write_scene(tmp_path / "s.ply", *stored, a_report())
    file = tmp_path / "s" / "report.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    with pytest.raises(QuerySplatError, match=r"report\.json is damaged"):
        read_scene(tmp_path / "s")
    entries = {key: value for key, value in a_report().items() if key not in changes or key == "more"}
    file.write_text(json.dumps(entries))
    if len(entries) < len(a_report()):
        with pytest.raises(QuerySplatError, match=r"report\.json is damaged"):
            read_scene(tmp_path / "s")


def fewer(content: dict[str, Any]) -> None:
    content["frames"].pop()


def more(content: dict[str, Any]) -> None:
    content["frames"].append({**content["frames"][0], "file_path": "images/e.png"})


def twice(content: dict[str, Any]) -> None:
    content["frames"][1] = content["frames"][0]


def half_a_letter(content: dict[str, Any]) -> None:
    content["frames"][0]["file_path"] = "images/\ud800.png"


def elsewhere(content: dict[str, Any]) -> None:
    content["frames"][0]["file_path"] = "../../../../../etc/passwd"


def small_canvas(content: dict[str, Any]) -> None:
    content["canvas"] = [2, 2]


def large_canvas(content: dict[str, Any]) -> None:
    content["canvas"] = [90_000, 90_000]


def other_size(content: dict[str, Any]) -> None:
    content["frames"][0]["w"] = 30


@pytest.mark.parametrize(
    "damage", [fewer, more, twice, half_a_letter, elsewhere, small_canvas, large_canvas, other_size]
)
def test_cameras_that_do_not_fit_the_memories_are_refused(
    damage: Callable[[dict[str, Any]], None], stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    write_scene(tmp_path / "s.ply", *stored, a_report())
    file = tmp_path / "s" / "cameras.json"
    content = json.loads(file.read_text())
    damage(content)
    file.write_text(json.dumps(content))
    with pytest.raises(QuerySplatError):
        read_scene(tmp_path / "s")


def test_memories_of_another_model_are_refused(stored: tuple[StoredScene, Gaussians]) -> None:
    config = preset("compact")
    scene, _ = stored
    with pytest.raises(QuerySplatError, match="memories"):
        check_model(scene, config)
    rows = len(scene.memories.geometry_keys), len(scene.memories.appearance_keys)
    shape = (config.heads, config.width // config.heads)
    fitting = Memories(*(torch.zeros(count, *shape) for count in (rows[0], rows[0], rows[1], rows[1])))
    assert scene.anchors is not None
    features = torch.zeros(len(scene.anchors), config.anchor_features)
    scene = replace(scene, anchors=replace(scene.anchors, features=features))
    check_model(replace(scene, memories=fitting), config)
    with pytest.raises(QuerySplatError, match="kept"):
        check_model(replace(scene, memories=fitting, kept=torch.ones(5, dtype=torch.bool)), config)
    other = replace(scene, memories=fitting, anchors=replace(scene.anchors, features=scene.anchors.features[:, :3]))
    with pytest.raises(QuerySplatError, match=r"anchors\.features"):
        check_model(other, config)
