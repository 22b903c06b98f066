"""Streamed SOG: the files are as the format asks for, and damaged ones are refused."""

import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_compressed import assert_close, cloud

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats import sog
from querysplat_cli.scene.formats.lod_tree import divided, extents, morton_codes
from querysplat_cli.scene.formats.streamed_sog import Level, read_levels, read_streamed, write_streamed
from querysplat_cli.scene.gaussians import Gaussians

COUNT, LEAF, CHUNK = 300, 40, 100
SCENE, BACKDROP = cloud(COUNT, 1), cloud(20, 1, reach=40.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two levels; the coarser one has every other Gaussian of each leaf."""
    folder = tmp_path_factory.mktemp("streamed") / "a.lod"
    division, leaf = divided(SCENE.means.double().numpy(), LEAF)
    leaves = torch.from_numpy(leaf)
    rows = torch.argsort(leaves, stable=True)[::2]
    folder.mkdir()
    levels = [Level(SCENE, leaves), Level(SCENE[rows], leaves[rows])]
    write_streamed(folder, levels, division, BACKDROP, CHUNK)
    return folder


def leaves_of(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The leaves below a node; checks on the way that bounds hold what is in them."""
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        yield node
        return
    assert len(node["children"]) == 2
    for side, choose in (("min", min), ("max", max)):
        for axis in range(3):
            assert node["bound"][side][axis] == choose(child["bound"][side][axis] for child in node["children"])
    for child in node["children"]:
        yield from leaves_of(child)


def stored(folder: Path) -> Gaussians:
    """A chunk, decoded without what reads the index."""
    meta = json.loads((folder / "meta.json").read_text())
    return sog.decoded(meta, lambda name: sog.unpacked((folder / name).read_bytes()))


def test_the_finest_level_comes_back(written: Path) -> None:
    """In the order of the file, to the precision of SOG; the backdrop is at the end."""
    for path in (written, written / "lod-meta.json"):
        found = read_streamed(path)
        assert len(found) == COUNT + len(BACKDROP)
    distances = torch.cdist(found.means[:COUNT], SCENE.means)
    nearest = distances.argmin(1)
    assert sorted(nearest.tolist()) == list(range(COUNT))
    assert_close(found[:COUNT], SCENE[nearest], position=2e-3, colour=0.02, rest=0.9)
    assert_close(found[COUNT:], BACKDROP, position=2e-2, colour=0.02, rest=0.9)


def test_the_index_is_as_the_format_says(written: Path) -> None:
    meta = json.loads((written / "lod-meta.json").read_text())
    assert (meta["version"], meta["lodLevels"], meta["environment"]) == (1, 2, "env/meta.json")
    assert meta["counts"] == [COUNT, COUNT // 2]
    assert meta["count"] == COUNT + COUNT // 2
    levels = [(count, len(gaussians)) for count, gaussians in read_levels(written)]
    assert levels == [(count, count + len(BACKDROP)) for count in meta["counts"]]
    assert all((written / name).is_file() for name in meta["filenames"])
    folders = {path.name for path in written.iterdir() if path.is_dir()}
    assert folders == {"env", *(name.split("/")[0] for name in meta["filenames"])}
    assert len(meta["filenames"]) > 2  # several chunks of the finest level


def test_every_gaussian_is_in_one_leaf_of_each_level_and_inside_its_bound(written: Path) -> None:
    meta = json.loads((written / "lod-meta.json").read_text())
    seen: Counter[tuple[int, int]] = Counter()
    for leaf in leaves_of(meta["tree"]):
        assert leaf["lods"].keys() == {"0", "1"}
        assert leaf["lods"]["0"]["count"] <= LEAF
        low, high = (np.array(leaf["bound"][side]) for side in ("min", "max"))
        for level, run in leaf["lods"].items():
            name = meta["filenames"][run["file"]]
            assert name.startswith(f"{level}_")
            rows = range(run["offset"], run["offset"] + run["count"])
            seen.update((run["file"], row) for row in rows)
            part = stored((written / name).parent)[torch.tensor(rows)]
            least, largest = extents(part)
            assert (least >= low).all()
            assert (largest <= high).all()
    sizes = [json.loads((written / name).read_text())["count"] for name in meta["filenames"]]
    assert max(sizes) <= CHUNK
    assert seen == Counter((file, row) for file, size in enumerate(sizes) for row in range(size))


def test_ellipsoids_reach_three_standard_deviations() -> None:
    """Against points on the surface of each ellipsoid."""
    scene = cloud(20, 0)
    low, high = extents(scene)
    chance = torch.Generator().manual_seed(1)
    sphere = torch.nn.functional.normalize(torch.randn(4000, 3, generator=chance), dim=1)
    quats = torch.nn.functional.normalize(scene.quats, dim=1)
    for i in range(len(scene)):
        turn = Rotation.from_quat(quats[i, [1, 2, 3, 0]].numpy())
        surface = turn.apply((3 * scene.scales[i] * sphere).numpy()) + scene.means[i].numpy()
        size = high[i] - low[i]
        assert (surface >= low[i] - 1e-6).all()
        assert (surface <= high[i] + 1e-6).all()
        np.testing.assert_allclose(surface.min(0), low[i], atol=0.03 * size.max())


def test_mortons_curve_goes_through_the_octants_in_turn() -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    assert (np.diff(morton_codes(corners)) > 0).all()
    inner = np.concatenate([corners, corners / 4])  # the first octant again, divided
    order = np.argsort(morton_codes(inner), kind="stable")
    assert set(order[:9]) == {0, *range(8, 16)}


def test_runs_are_in_mortons_order(written: Path) -> None:
    """Of the centres as given; nothing is in order across leaves."""
    meta = json.loads((written / "lod-meta.json").read_text())
    codes = morton_codes(SCENE.means.double().numpy())
    for leaf in leaves_of(meta["tree"]):
        run = leaf["lods"]["0"]
        part = stored((written / meta["filenames"][run["file"]]).parent)[run["offset"] : run["offset"] + run["count"]]
        rows = torch.cdist(part.means, SCENE.means).argmin(1).numpy()
        assert (np.diff(codes[rows]) >= 0).all()


def test_a_scene_of_one_gaussian_has_a_tree_of_one_leaf(tmp_path: Path) -> None:
    division, leaf = divided(SCENE.means[:1].double().numpy(), LEAF)
    write_streamed(tmp_path, [Level(SCENE[:1], torch.from_numpy(leaf))], division, None, CHUNK)
    assert "lods" in json.loads((tmp_path / "lod-meta.json").read_text())["tree"]
    assert len(read_streamed(tmp_path)) == 1


def test_what_is_of_before_the_version_was_written_is_read(written: Path, tmp_path: Path) -> None:
    shutil.copytree(written, tmp_path / "old")
    meta = json.loads((written / "lod-meta.json").read_text())
    for key in ("version", "count", "counts", "asset"):
        del meta[key]
    (tmp_path / "old" / "lod-meta.json").write_text(json.dumps({**meta, "environment": None, "new": 1}))
    assert len(read_streamed(tmp_path / "old")) == COUNT


def first(node: dict[str, Any]) -> dict[str, Any]:
    return next(leaves_of(node))


DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "another version": (lambda meta: meta.update(version=2), "version is 2"),
    "no tree": (lambda meta: meta.pop("tree"), "tree"),
    "a count too many": (lambda meta: meta["counts"].__setitem__(0, 301), "not as many"),
    "a total too many": (lambda meta: meta.update(count=1), "not as many"),
    "an offset": (lambda meta: first(meta["tree"])["lods"]["0"].update(offset=1), "exactly once"),
    "a negative offset": (lambda meta: first(meta["tree"])["lods"]["0"].update(offset=-1), "whole number"),
    "no such file": (lambda meta: first(meta["tree"])["lods"]["0"].update(file=99), "no such one"),
    "a file twice": (lambda meta: meta.update(filenames=meta["filenames"] * 2), "names a file twice"),
    "no such level": (lambda meta: meta.update(lodLevels=1), "no such one"),
    "levels mixed": (lambda meta: swap(meta), "several levels"),
    "a bound that is no box": (lambda meta: meta["tree"]["bound"].update(min=[9, 9, 9]), "no box"),
    "a bound that is too small": (lambda meta: squeeze(first(meta["tree"])), "outside the bound"),
    "a child outside": (lambda meta: first(meta["tree"])["bound"].update(max=[99, 99, 99]), "that of its parent"),
    "both": (lambda meta: first(meta["tree"]).update(children=[]), "both"),
    "a path out of the folder": (lambda meta: meta["filenames"].__setitem__(0, "../x/meta.json"), "in its folder"),
    "a chunk that is missing": (lambda meta: meta["filenames"].__setitem__(0, "9_9/meta.json"), "9_9"),
    "chunks exchanged": (lambda meta: meta["filenames"].reverse(), "its leaves have"),
}


def swap(meta: dict[str, Any]) -> None:
    """The runs of a leaf under each other's level; without counts, these do not give it away."""
    lods = first(meta["tree"])["lods"]
    lods["0"], lods["1"] = lods["1"], lods["0"]
    del meta["counts"], meta["count"]


def squeeze(leaf: dict[str, Any]) -> None:
    leaf["bound"]["max"] = leaf["bound"]["min"]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_index_is_refused(written: Path, damage: str) -> None:
    """Beside the sound one, so that the chunks are there."""
    meta = json.loads((written / "lod-meta.json").read_text())
    change, message = DAMAGE[damage]
    change(meta)
    copy = written / "damaged.json"
    copy.write_text(json.dumps(meta))
    with pytest.raises(QuerySplatError, match=message) as raised:
        read_streamed(copy)
    assert "\n" not in str(raised.value)


def test_ten_times_the_names_and_runs_take_ten_times_as_long(written: Path) -> None:
    """Runs were once searched through for every name, which takes a hundred times as long."""
    meta = json.loads((written / "lod-meta.json").read_text())

    def seconds(count: int) -> float:
        runs = [
            {"bound": meta["tree"]["bound"], "lods": {"0": {"file": i, "offset": 0, "count": 0}}} for i in range(count)
        ]
        tree = {"bound": meta["tree"]["bound"], "children": runs}
        copy = written / "many.json"
        copy.write_text(json.dumps({"lodLevels": 1, "filenames": list(map(str, range(count))), "tree": tree}))
        began = time.process_time()
        with pytest.raises(QuerySplatError, match="No such file"):
            read_streamed(copy)
        return time.process_time() - began

    assert seconds(20_000) < 40 * seconds(2_000)


def test_what_is_no_index_and_what_is_cut_is_refused(written: Path, tmp_path: Path) -> None:
    for content in ("", "[]", "{}", "null", '{"version": 1, "lodLevels": "2"}'):
        (tmp_path / "lod-meta.json").write_text(content)
        with pytest.raises(QuerySplatError, match="damaged"):
            read_streamed(tmp_path)
    with pytest.raises(QuerySplatError, match="no such file"):
        read_streamed(tmp_path / "nothing.lod")
    bound = {"min": [0, 0, 0], "max": [1, 1, 1]}
    empty = {"lodLevels": 0, "filenames": [], "tree": {"bound": bound, "children": []}}
    (tmp_path / "lod-meta.json").write_text(json.dumps(empty))
    with pytest.raises(QuerySplatError, match="it has no level"):
        read_streamed(tmp_path)
    shutil.copytree(written, tmp_path / "cut")
    picture = tmp_path / "cut" / "0_0" / "means_l.webp"
    picture.write_bytes(picture.read_bytes()[:50])
    with pytest.raises(QuerySplatError, match="damaged"):
        read_streamed(tmp_path / "cut")
