"""glTF with KHR_gaussian_splatting."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_compressed import cloud

from querysplat_cli.pipeline.gaussian_files import FLIPPED, read_gaussians, write_gaussians
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.gltf import EXTENSION, read_glb, write_glb
from querysplat_cli.scene.formats.mesh import TriangleMesh, write_mesh
from querysplat_cli.splat.transform import transform_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_back(tmp_path: Path, degree: int) -> None:
    scene = cloud(50, degree)
    assert write_glb(tmp_path / "a.glb", scene) == 50
    [(found, place)] = read_glb(tmp_path / "a.glb")
    assert place is None
    for name in ("means", "scales", "opacities", "sh"):
        assert getattr(found, name).equal(getattr(scene, name)), name
    torch.testing.assert_close(found.quats, torch.nn.functional.normalize(scene.quats, dim=1))


def test_the_file_is_valid_gltf(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", cloud(7, 1))
    content = (tmp_path / "a.glb").read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
    assert length % 4 == 0
    document = json.loads(content[20 : 20 + length])
    assert document["extensionsUsed"] == [EXTENSION]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    names = {name.removeprefix(f"{EXTENSION}:") for name in primitive["attributes"]}
    bands = {"SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{n}" for n in range(3))}
    assert names == {"POSITION", "ROTATION", "SCALE", "OPACITY", *bands}
    kinds = {"POSITION": "VEC3", f"{EXTENSION}:ROTATION": "VEC4", f"{EXTENSION}:OPACITY": "SCALAR"}
    for name, wanted in kinds.items():
        accessor = document["accessors"][primitive["attributes"][name]]
        assert (accessor["type"], accessor["count"], accessor["componentType"]) == (wanted, 7, 5126)
    last = document["bufferViews"][-1]
    assert last["byteOffset"] + last["byteLength"] == document["buffers"][0]["byteLength"]
    assert {"min", "max"} <= document["accessors"][primitive["attributes"]["POSITION"]].keys()


def test_y_is_up_in_the_file_and_down_in_a_scene(tmp_path: Path) -> None:
    scene = cloud(20, 1)
    write_gaussians(tmp_path / "a.glb", scene)
    torch.testing.assert_close(read_glb(tmp_path / "a.glb")[0][0].means, scene.means * torch.tensor([1.0, -1.0, -1.0]))
    found = read_gaussians(tmp_path / "a.glb")
    torch.testing.assert_close(found.means, scene.means)
    torch.testing.assert_close(found.sh, scene.sh, atol=1e-5, rtol=1e-5)


def document_of(path: Path) -> dict[str, Any]:
    """The JSON of a .glb."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    found: dict[str, Any] = json.loads(content[20 : 20 + length])
    return found


def rewritten(path: Path, **changes: object) -> Path:
    """The file with other entries in its JSON."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    listing = json.dumps({**document_of(path), **changes}).encode()
    listing += b" " * (-len(listing) % 4)
    rest = content[20 + length :]
    header = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(listing) + len(rest), len(listing), b"JSON")
    path.write_bytes(header + listing + rest)
    return path


def test_nodes_place_the_gaussians(tmp_path: Path) -> None:
    scene = cloud(20, 1)
    write_glb(tmp_path / "a.glb", scene)
    turned = {"rotation": [0, 0, 0.5**0.5, 0.5**0.5], "children": [0]}
    file = rewritten(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [2, 2, 2], "translation": [1, 0, 0]}, turned])
    found = transform_gaussians(read_gaussians(file), FLIPPED)
    x, y, z = scene.means.unbind(1)
    torch.testing.assert_close(found.means, torch.stack([-2 * y, 2 * x + 1, 2 * z], 1))
    torch.testing.assert_close(found.scales, 2 * scene.scales)
    by_columns = [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 0, 1, 0, 1]
    same = transform_gaussians(read_gaussians(rewritten(file, nodes=[{"mesh": 0, "matrix": by_columns}])), FLIPPED)
    torch.testing.assert_close(same.means, found.means)
    torch.testing.assert_close(same.quats.abs(), found.quats.abs())


@pytest.mark.parametrize(
    ("node", "why"),
    [({"scale": [1, 2, 1]}, "stretches"), ({"scale": [-1, 1, 1]}, "mirrors"), ({"children": [0]}, "children")],
)
def test_nodes_that_change_shapes_are_refused(tmp_path: Path, node: dict[str, object], why: str) -> None:
    write_glb(tmp_path / "a.glb", cloud(7, 1))
    with pytest.raises(QuerySplatError, match=why):
        read_glb(rewritten(tmp_path / "a.glb", nodes=[{"mesh": 0, **node}]))


def test_strides_are_kept_to(tmp_path: Path) -> None:
    scene = cloud(7, 0)
    write_glb(tmp_path / "a.glb", scene)
    document = document_of(tmp_path / "a.glb")
    views = [{**view, "byteStride": view["byteLength"] // 7} for view in document["bufferViews"]]
    assert read_glb(rewritten(tmp_path / "a.glb", bufferViews=views))[0][0].means.equal(scene.means)
    views[0] |= {"byteStride": 24}
    accessors = [{**accessor, "count": 4} for accessor in document["accessors"]]
    found = read_glb(rewritten(tmp_path / "a.glb", bufferViews=views, accessors=accessors))[0][0]
    assert found.means.equal(scene.means[::2])


def test_integers_stand_for_shares_of_one(tmp_path: Path) -> None:
    """The specification allows them for rotations, scales and opacities. Such files were called damaged."""
    scene = cloud(7, 0)
    scene = replace(scene, scales=scene.scales.clamp(max=1.0))
    write_glb(tmp_path / "a.glb", scene)
    content = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document, binary = json.loads(content[20 : 20 + length]), bytearray(content[28 + length :])
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    quats = torch.nn.functional.normalize(scene.quats, dim=1)[:, [1, 2, 3, 0]]
    columns = {"ROTATION": ("i1", 5120, 127, quats), "SCALE": ("<u2", 5123, 65535, scene.scales)}
    columns |= {"OPACITY": ("u1", 5121, 255, scene.opacities)}
    for name, (kind, number, one, values) in columns.items():
        accessor = document["accessors"][attributes[f"{EXTENSION}:{name}"]]
        accessor |= {"componentType": number, "normalized": True}
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        packed = (values.double().numpy() * one).round().astype(kind).tobytes()
        binary[start : start + len(packed)] = packed
    (tmp_path / "a.glb").write_bytes(content[: 28 + length] + binary)
    found = read_glb(rewritten(tmp_path / "a.glb", accessors=document["accessors"]))[0][0]
    torch.testing.assert_close(found.quats, quats[:, [3, 0, 1, 2]], atol=0.5 / 127, rtol=0)
    torch.testing.assert_close(found.scales, scene.scales, atol=0.5 / 65535, rtol=1e-6)
    torch.testing.assert_close(found.opacities, scene.opacities, atol=0.5 / 255, rtol=1e-6)


def test_all_primitives_of_all_meshes_are_read(tmp_path: Path) -> None:
    """Only the first primitive was read, without a word."""
    scene, file = cloud(7, 0), tmp_path / "a.glb"
    write_glb(file, scene)
    document = document_of(file)
    [mesh] = document["meshes"]
    [(found, _)] = read_glb(rewritten(file, meshes=[{"primitives": 2 * mesh["primitives"]}]))
    assert found.means.equal(torch.cat([scene.means, scene.means]))
    nodes = [{"mesh": 0, "translation": [1, 0, 0]}, {"mesh": 2, "scale": [2, 2, 2]}]
    solid = {"primitives": [{"attributes": {"POSITION": 0}}]}
    both = transform_gaussians(read_gaussians(rewritten(file, meshes=[mesh, solid, mesh], nodes=nodes)), FLIPPED)
    moved = scene.means + torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(both.means, torch.cat([moved, 2 * scene.means]))
    torch.testing.assert_close(both.scales, torch.cat([scene.scales, 2 * scene.scales]))


@pytest.mark.parametrize("place", ["primitive", "bufferView"])
def test_compression_is_named(tmp_path: Path, place: str) -> None:
    file = tmp_path / "a.glb"
    write_glb(file, cloud(7, 0))
    document = document_of(file)
    primitive, view = document["meshes"][0]["primitives"][0], document["bufferViews"][0]
    (primitive["extensions"][EXTENSION] if place == "primitive" else view)["extensions"] = {"EXT_small": {}}
    with pytest.raises(QuerySplatError, match="compressed with EXT_small, which is not read"):
        read_glb(rewritten(file, meshes=document["meshes"], bufferViews=document["bufferViews"]))


def test_logarithms_of_scales_are_read_as_such(tmp_path: Path) -> None:
    """Drafts of the specification, and splat-transform until June 2026, have them."""
    scene = cloud(7, 0)
    write_glb(tmp_path / "a.glb", replace(scene, scales=scene.scales.log()))
    torch.testing.assert_close(read_glb(tmp_path / "a.glb")[0][0].scales, scene.scales)


def test_linear_colours_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.glb"
    write_glb(file, cloud(7, 0))
    document = document_of(file)
    document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["colorSpace"] = "lin_rec709_display"
    with pytest.raises(QuerySplatError, match="colours are those of lin_rec709_display"):
        read_glb(rewritten(file, meshes=document["meshes"]))


def test_colours_of_a_mesh_are_linear(tmp_path: Path) -> None:
    """As glTF says of COLOR_0. An sRGB of 188 is half of the light."""
    trimesh = pytest.importorskip("trimesh")
    colours = np.array([[0, 10, 188], [255, 128, 50], [1, 2, 3]], np.uint8)
    places = np.array([[0, 0, 2], [1, 0, 2], [0, 1, 3]], np.float32)
    write_mesh(tmp_path / "m.glb", TriangleMesh(places, colours, np.array([[0, 1, 2]])))
    content = (tmp_path / "m.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = 28 + length + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    stored = np.frombuffer(content, "<u2", 12, start).reshape(3, 4) / 65535
    assert stored[0, 2] == pytest.approx(0.5029, abs=1e-4)
    assert stored[1, :2] == pytest.approx([1, 0.2159], abs=1e-4)
    assert stored[0, 1] == pytest.approx(10 / 255 / 12.92, abs=1e-5)
    assert (stored[:, 3] == 1).all()
    found = trimesh.load(tmp_path / "m.glb", process=False, force="mesh")
    assert found.vertices == pytest.approx(places * [1, -1, -1])
    assert found.faces.tolist() == [[0, 1, 2]]
    write_mesh(tmp_path / "m.ply", TriangleMesh(places, colours, np.array([[0, 1, 2]])))
    found = trimesh.load(tmp_path / "m.ply", process=False)
    assert found.visual.vertex_colors[:, :3].tolist() == colours.tolist()  # as other tools take those of a .ply


@pytest.mark.parametrize("content", [b"", b"no such file", b"glTF" + bytes(40)])
def test_damaged_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(QuerySplatError, match="damaged"):
        read_glb(tmp_path / "a.glb")


def test_a_file_that_ends_early_is_refused(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", cloud(7, 1))
    content = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "a.glb").write_bytes(content[:-40])
    with pytest.raises(QuerySplatError, match="damaged"):
        read_glb(tmp_path / "a.glb")
