""".spz: the error after writing and reading is that of their quantisation."""

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.pipeline.gaussian_files import read_gaussians
from querysplat_cli.reporting.omissions import of_kind
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.formats.compressed import read_spz, write_spz
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.gaussians import Gaussians


def cloud(count: int, degree: int, *, reach: float = 3.0) -> Gaussians:
    chance = torch.Generator().manual_seed(count + degree)
    sh = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=chance)
    return Gaussians(
        reach * (2 * torch.rand(count, 3, generator=chance) - 1),
        torch.randn(count, 4, generator=chance),
        torch.exp(-4 + torch.randn(count, 3, generator=chance)),
        0.05 + 0.9 * torch.rand(count, generator=chance),
        sh,
    )


def assert_close(found: Gaussians, original: Gaussians, *, position: float, colour: float, rest: float) -> None:
    """Within the steps of the format; rotations by their angle, as a quaternion and its negative are one."""
    assert len(found) == len(original)
    assert found.sh_degree == original.sh_degree
    assert float((found.means - original.means).abs().max()) <= position
    assert float((found.opacities - original.opacities).abs().max()) <= 0.6 / 255
    assert float((found.scales.log() - original.scales.log()).abs().max()) <= 0.07
    one, other = (torch.nn.functional.normalize(part.quats, dim=1) for part in (found, original))
    assert float((one * other).sum(1).abs().min()) > 0.99
    assert float((found.sh[:, 0] - original.sh[:, 0]).abs().max()) <= colour
    if original.sh_degree:
        assert float((found.sh[:, 1:] - original.sh[:, 1:]).abs().max()) <= rest


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("reach", [0.01, 3.0, 3000.0])
def test_spz_keeps_24_bits_of_position_whatever_the_size(
    tmp_path: Path, degree: int, reach: float, version: int
) -> None:
    pytest.importorskip("gsply")
    scene = cloud(300, degree, reach=reach)
    assert write_spz(tmp_path / "a.spz", scene, version) == 300
    step = max(2.0**-20, 4 * reach * 2.0**-23)
    assert_close(read_spz(tmp_path / "a.spz"), scene, position=step, colour=0.6 / (0.15 * 255), rest=0.6 / 128)


def test_the_header_of_version_4(tmp_path: Path) -> None:
    """Plain bytes, as Niantic's readers expect them: magic, version, points, degree, bits, flags, streams, and where
    the table of contents starts."""
    pytest.importorskip("zstandard")
    write_spz(tmp_path / "a.spz", cloud(50, 2), 4)
    content = (tmp_path / "a.spz").read_bytes()
    magic, version, points, degree, _, flags, streams, table = struct.unpack_from("<IIIBBBBI", content)
    assert (magic, version, points, degree, flags, streams, table) == (0x5053474E, 4, 50, 2, 0, 6, 32)
    sizes = [struct.unpack_from("<QQ", content, 32 + 16 * stream) for stream in range(6)]
    assert 32 + 16 * 6 + sum(packed for packed, _ in sizes) == len(content)
    assert [raw for _, raw in sizes] == [50 * 9, 50, 50 * 3, 50 * 3, 50 * 4, 50 * 24]


def test_rows_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    pytest.importorskip("gsply")
    scene = cloud(5, 0)
    means = scene.means.clone()
    means[2, 1] = float("nan")
    broken = Gaussians(means, scene.quats, scene.scales, scene.opacities, scene.sh)
    assert write_spz(tmp_path / "a.spz", broken) == 4
    assert len(read_spz(tmp_path / "a.spz")) == 4


def test_what_is_moved_to_the_border_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As in UTM: 24 bits of a coordinate, of which one is fractional, end at 4,194,304."""
    pytest.importorskip("gsply")
    scene = cloud(4, 0)
    scene = replace(scene, means=torch.tensor([[0.0, 0, 0], [4e6, 0, 1], [0, -5e6, 2], [0, 0, 1e7]]))
    write_ply(tmp_path / "a.ply", scene)
    for kind, count in (("spz", 2), ("glb", 0)):
        assert run(["convert", str(tmp_path / "a.ply"), str(tmp_path / f"b.{kind}"), "--json"]) == 0
        shown = capsys.readouterr()
        assert json.loads(shown.out)["at_border"] == count
        assert ("warning: 2 Gaussians beyond ±4,194,304" in shown.err) == bool(count)
    moved = read_gaussians(tmp_path / "b.spz").means - scene.means
    assert (moved.abs() > 1).any(1).tolist() == [False, False, True, True]
    (lost,) = of_kind(tmp_path / "b.spz", scene, 1.0)
    assert lost.why.endswith("2 Gaussians beyond that moved to there")


@pytest.mark.parametrize("content", [b"", b"no such file", b"\x1f\x8b\x08" + bytes(40)])
def test_damaged_files_are_refused(tmp_path: Path, content: bytes) -> None:
    pytest.importorskip("gsply")
    file = tmp_path / "a.spz"
    file.write_bytes(content)
    with pytest.raises(QuerySplatError, match="damaged"):
        read_spz(file)


def test_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsply", None)
    for action in (
        lambda: read_spz(tmp_path / "a.spz"),
        lambda: write_spz(tmp_path / "a.spz", cloud(3, 0)),
    ):
        with pytest.raises(MissingPart) as caught:
            action()
        assert "querysplat[formats]" in caught.value.hint
    assert list(tmp_path.iterdir()) == []
