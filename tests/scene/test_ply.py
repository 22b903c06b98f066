"""The .ply: writing and reading keep the scene, other tools read it, and other files are refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from safetensors.torch import load_file

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.ply import columns, export_rows, read_ply, write_ply
from querysplat_cli.scene.gaussians import Gaussians


def gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731 - three uses, one line
    return Gaussians(
        means=10 * normal(count, 3),
        quats=normal(count, 4),
        scales=(2 * normal(count, 3) - 4).exp(),
        opacities=normal(count).mul(4).sigmoid().clamp(1e-6, 1 - 6e-8),
        sh=normal(count, (degree + 1) ** 2, 3),
    )


@given(count=st.integers(1, 40), degree=st.integers(0, 3), seed=st.integers(0, 1000))
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, count: int, degree: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    scene = gaussians(count, degree, seed)
    assert write_ply(path, scene) == count
    back = read_ply(path)
    assert back.sh_degree == degree
    torch.testing.assert_close(back.means, scene.means, rtol=0, atol=0)
    torch.testing.assert_close(back.sh, scene.sh, rtol=0, atol=0)
    torch.testing.assert_close(back.quats, torch.nn.functional.normalize(scene.quats), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(back.scales, scene.scales, rtol=2e-6, atol=2e-8)
    torch.testing.assert_close(back.opacities, scene.opacities, rtol=2e-6, atol=1e-7)


def test_a_scene_without_a_finite_gaussian_is_not_written(tmp_path: Path) -> None:
    none = gaussians(3, 0)
    none.means[:] = torch.nan
    for scene in (none, gaussians(3, 0)[:0]):
        with pytest.raises(QuerySplatError, match="no Gaussian"):
            write_ply(tmp_path / "scene.ply", scene)
    assert not list(tmp_path.iterdir())


def test_a_name_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="not the name of a"):
        write_ply(tmp_path / "scene.spz", gaussians(3, 0))
    assert not list(tmp_path.iterdir())


def test_the_header_and_the_columns_are_the_standard_ones(tmp_path: Path) -> None:
    """Read back by plyfile alone: names, types, f_rest colour by colour, logits and logarithms."""
    path = tmp_path / "scene.ply"
    scene = gaussians(5, 1)
    write_ply(path, scene, comments=["made by a test"])
    data = PlyData.read(path)
    assert (data.byte_order, data.text, data.comments) == ("<", False, ["made by a test"])
    assert [element.name for element in data.elements] == ["vertex"]
    vertices = data["vertex"]
    rest = [f"f_rest_{i}" for i in range(9)]
    assert [p.name for p in vertices.properties] == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(*rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    assert {p.val_dtype for p in vertices.properties} == {"f4"}
    np.testing.assert_array_equal(vertices["f_rest_4"], scene.sh[:, 2, 1])
    opacity = scene.opacities.double().numpy()
    np.testing.assert_allclose(vertices["opacity"], np.log(opacity / (1 - opacity)), rtol=1e-6)
    np.testing.assert_allclose(vertices["scale_1"], np.log(scene.scales[:, 1].double().numpy() + 1e-8), rtol=1e-6)
    assert not vertices["nx"].any()


def test_rows_are_those_of_the_released_exporter(golden: Path) -> None:
    fixture = load_file(golden / "ply_export.safetensors")
    means, opacities, scales, quats, sh = fixture["gaussians"][0].split([3, 1, 3, 4, 12], 1)
    rows = export_rows(Gaussians(means, quats, scales, opacities[:, 0], sh.unflatten(1, (4, 3))), 0.05)
    assert rows.shape == fixture["rows"].shape
    assert len(columns(1)) == rows.shape[1]
    error = (rows - fixture["rows"]).abs().max() / fixture["rows"].abs().max()
    assert error < 1e-6


def test_extremes_stay_finite(tmp_path: Path) -> None:
    scene = gaussians(4, 0)
    scene.opacities[:] = torch.tensor([0.0, 1.0, 1 - 6e-8, 1e-30])
    scene.scales[0] = torch.tensor([0.0, 1e-30, 1e30])
    scene.quats[:] = torch.tensor([[0.0, 0, 0, 0], [1e-20, 0, 0, 0], [0, 1e20, 0, 0], [0, 0, -3, 4]])
    assert torch.isfinite(export_rows(scene)).all()
    write_ply(tmp_path / "scene.ply", scene)
    back = read_ply(tmp_path / "scene.ply")
    assert (back.opacities < 1).all()
    expected = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -0.6, 0.8]])
    torch.testing.assert_close(back.quats, expected)


@pytest.mark.parametrize(
    ("field", "poison"),
    [
        *((field, float("nan")) for field in ("means", "quats", "scales", "opacities", "sh")),
        *((field, float("inf")) for field in ("means", "quats", "scales", "sh")),
    ],
)
def test_rows_that_are_not_finite_are_left_out_and_counted(tmp_path: Path, field: str, poison: float) -> None:
    scene = gaussians(6, 1)
    getattr(scene, field).view(6, -1)[2, -1] = poison
    assert write_ply(tmp_path / "scene.ply", scene) == 5
    torch.testing.assert_close(read_ply(tmp_path / "scene.ply").means, scene.means[[0, 1, 3, 4, 5]])


def test_names_decide_not_the_order_and_other_properties_do_not_matter(tmp_path: Path) -> None:
    scene = gaussians(7, 2)
    names, rows = columns(2), export_rows(scene).numpy()
    shuffled = ["label", *np.random.default_rng(0).permutation(names).tolist()]
    vertices = np.zeros(7, [(name, "i4" if name == "label" else ">f8") for name in shuffled])
    for name, column in zip(names, rows.T, strict=True):
        vertices[name] = column
    extra = PlyElement.describe(np.zeros(2, [("value", "f4")]), "camera")
    for text in (False, True):
        PlyData([extra, PlyElement.describe(vertices, "vertex")], text=text, byte_order=">").write(tmp_path / "a.ply")
        torch.testing.assert_close(read_ply(tmp_path / "a.ply").sh, scene.sh)


@pytest.mark.parametrize("code", ["utf-8", "latin-1"])
def test_comments_may_have_letters_beyond_ascii(tmp_path: Path, code: str) -> None:
    write_ply(tmp_path / "a.ply", gaussians(5, 1), ["made by X"])
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content.replace(b"made by X", "fotos/café".encode(code)))
    assert read_ply(tmp_path / "b.ply").means.equal(read_ply(tmp_path / "a.ply").means)
    (tmp_path / "b.ply").write_bytes(content.replace(b"made by X", "café".encode(code)) + b"more")
    with pytest.raises(QuerySplatError, match="more data than its header says"):
        read_ply(tmp_path / "b.ply")


def test_saturated_numbers_of_other_writers_are_read(tmp_path: Path) -> None:
    """An exporter that clamps in float32 writes an infinite logit for an opacity of 1 or 0."""
    names = columns(0)
    vertices = np.zeros(4, [(name, "f4") for name in names])
    vertices["rot_0"] = 1
    vertices["opacity"] = [np.inf, -np.inf, 0, 0]
    vertices["scale_0"] = [0, -np.inf, 200, np.nan]
    PlyData([PlyElement.describe(vertices, "vertex")]).write(tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply")
    assert len(back) == 3
    assert torch.isfinite(back.scales).all()
    assert back.opacities.tolist() == pytest.approx([1, 0, 0.5], abs=1e-6)
    assert (back.opacities < 1).all()
    assert (back.opacities > 0).all()  # levels of detail weigh by opacity, and two of 0 have no mean


def test_files_that_are_no_scene_are_refused(tmp_path: Path) -> None:
    mesh = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(mesh, "vertex")]).write(tmp_path / "mesh.ply")
    PlyData([PlyElement.describe(mesh, "camera")]).write(tmp_path / "camera.ply")
    odd = np.zeros(3, [(name, "f4") for name in [*columns(0), "f_rest_0"]])
    PlyData([PlyElement.describe(odd, "vertex")]).write(tmp_path / "odd.ply")
    write_ply(tmp_path / "whole.ply", gaussians(10, 0))
    whole = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-7])
    (tmp_path / "long.ply").write_bytes(whole + b"more")
    (tmp_path / "header.ply").write_bytes(whole[:60])
    (tmp_path / "text.ply").write_text("not a ply")
    (tmp_path / "noise.ply").write_bytes(bytes(range(256)))
    (tmp_path / "empty.ply").touch()
    for name, count in {"negative": b"-10", "absurd": b"9223372036854775808", "float": b"1e30", "none": b"0"}.items():
        (tmp_path / f"{name}.ply").write_bytes(whole.replace(b"vertex 10", b"vertex " + count))
    digits = b"9" * 5000
    (tmp_path / "digits.ply").write_bytes(whole.replace(b"vertex 10", b"vertex " + digits))
    (tmp_path / "list.ply").write_bytes(whole.replace(b"property float opacity", b"property list uchar float opacity"))
    write_ply(tmp_path / "misnamed.ply", gaussians(10, 1))
    misnamed = (tmp_path / "misnamed.ply").read_bytes().replace(b"f_rest_3", b"f_rest_x")
    (tmp_path / "misnamed.ply").write_bytes(misnamed)
    (tmp_path / "flat.ply").write_bytes(whole.replace(b"scale_2", b"other_2"))
    end = whole.index(b"end_header\n") + len(b"end_header\n")
    (tmp_path / "nan.ply").write_bytes(whole[:end] + b"\xff" * (len(whole) - end))
    (tmp_path / "huge.ply").write_bytes(whole.replace(b"vertex 10", b"vertex 99999999999999"))
    for name, message in {
        "missing": "no such file",
        "mesh": "not one of Gaussians: it has no f_dc_0",
        "flat": r"a \.ply of flat Gaussians \(2DGS\), which is not read",
        "camera": "without vertices",
        "odd": "1 f_rest properties",
        "cut": "damaged",
        "long": "more data than its header says",
        "header": "damaged",
        "text": "damaged",
        "noise": "damaged",
        "empty": "damaged",
        "huge": "damaged",
        "negative": "damaged",
        "absurd": "damaged",
        "float": "damaged",
        "digits": "damaged",
        "none": "more data",
        "list": "damaged|lists",
        "misnamed": "f_rest properties",
        "nan": "no Gaussian with finite numbers",
    }.items():
        with pytest.raises(QuerySplatError, match=message):
            read_ply(tmp_path / f"{name}.ply")


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.ply"
    write_ply(path, gaussians(3, 0))
    before = path.read_bytes()

    def interrupted(self: PlyData, stream: str) -> None:
        Path(stream).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(PlyData, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_ply(path, gaussians(9, 0))
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["scene.ply"]


def test_a_locked_file_is_not_called_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(path: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    write_ply(tmp_path / "scene.ply", gaussians(3, 0))
    monkeypatch.setattr(Path, "open", locked)
    with pytest.raises(QuerySplatError, match="no permission to read it"):
        read_ply(tmp_path / "scene.ply")
