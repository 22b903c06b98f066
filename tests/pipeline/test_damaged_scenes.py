"""A scene folder that was damaged is refused by name."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from stored_scene import a_report

from querysplat_cli.model.config import preset
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.read_scene import check_model, read_scene
from querysplat_cli.pipeline.scene_folder import StoredScene, write_scene
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import Gaussians

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


def a_map(scene: StoredScene) -> MemoryMap:
    """A map of the right rows, with confirmed depth in one pixel."""
    counts = len(scene.memories.geometry_keys), len(scene.memories.appearance_keys)
    confirmed = torch.zeros_like(scene.views.masks)
    confirmed[0, 1, 2] = True
    rows = (torch.arange(n).int() for n in counts)
    return MemoryMap(*rows, torch.tensor([0, 4, 6]).int(), torch.zeros(0, 0, 0), confirmed)


def test_a_map_that_names_rows_that_are_not_there_is_refused(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    scene, gaussians = stored
    where = a_map(scene)
    write_scene(tmp_path / "s.ply", replace(scene, map=where), gaussians, a_report())
    assert read_scene(tmp_path / "s")[0].map is not None
    for wrong in (
        replace(where, geometry_rows=where.geometry_rows + 1000),
        replace(where, appearance_rows=where.appearance_rows[:-1]),
        replace(where, grid=torch.tensor([-1, 4, 6]).int()),
        replace(where, depth=torch.zeros(1, 2, 3)),
        replace(where, confirmed=torch.zeros(1, 2, 3, dtype=torch.bool)),
    ):
        write_scene(tmp_path / "s.ply", replace(scene, map=wrong), gaussians, a_report())
        with pytest.raises(QuerySplatError, match=r"map\."):
            read_scene(tmp_path / "s")


def test_what_is_stored_in_half_precision_stays_so(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    """A scene that is read and written again takes no more space."""
    scene, gaussians = stored
    depth = torch.ones(len(scene.views), *scene.views.masks.shape[1:]).half()
    write_scene(tmp_path / "s.ply", replace(scene, map=replace(a_map(scene), depth=depth)), gaussians, a_report())
    again = read_scene(tmp_path / "s")[0]
    assert again.map
    assert again.map.depth.dtype == torch.float16
    assert again.memories.geometry_keys.dtype == torch.float32


def remove_tensor(folder: Path, name: str) -> None:
    """From the memories of a stored scene."""
    file = folder / "memories.safetensors"
    tensors = load_file(file)
    del tensors[name]
    save_file(tensors, file, metadata={"model": "compact"})


def test_a_scene_of_an_earlier_version_does_not_say_which_depth_is_confirmed(
    stored: tuple[StoredScene, Gaussians], tmp_path: Path
) -> None:
    scene, gaussians = stored
    where = a_map(scene)
    write_scene(tmp_path / "s.ply", replace(scene, map=where), gaussians, a_report())
    now = read_scene(tmp_path / "s")[0].map
    assert now is not None
    assert now.confirmed.equal(where.confirmed)
    remove_tensor(tmp_path / "s", "map.confirmed")
    before = read_scene(tmp_path / "s")[0].map
    assert before is not None
    assert not len(before.confirmed)


def test_a_scene_of_an_earlier_version_has_no_refinement(stored: tuple[StoredScene, Gaussians], tmp_path: Path) -> None:
    write_scene(tmp_path / "s.ply", *stored, a_report())
    remove_tensor(tmp_path / "s", "anchors.refinement")
    anchors = read_scene(tmp_path / "s")[0].anchors
    assert anchors is not None
    assert anchors.refinement.shape == (*anchors.opacities.shape, 0)


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
