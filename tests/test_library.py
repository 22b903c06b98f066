"""The package as a library: its few names, imported when they are used."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import querysplat_cli
from querysplat_cli import Gaussians


def test_every_name_leads_somewhere() -> None:
    for name in querysplat_cli.__all__:
        assert getattr(querysplat_cli, name)
    assert set(dir(querysplat_cli)) == set(querysplat_cli.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        querysplat_cli.nothing  # noqa: B018 - the access is the test


def test_the_import_loads_neither_torch_nor_pycolmap() -> None:
    code = (
        "import sys, querysplat_cli; querysplat_cli.__version__;"
        "heavy = {'torch', 'pycolmap', 'numba', 'cv2', 'scipy'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def red_gaussians(count: int) -> Gaussians:
    """In one place, 4 units in front of the first camera."""
    red = torch.tensor([[[1.7, -1.7, -1.7]]])
    return Gaussians(
        torch.tensor([[0.0, 0, 4]]).repeat(count, 1),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.2),
        torch.full((count,), 0.99),
        red.repeat(count, 1, 1),
    )


def test_a_scene_is_written_read_and_rendered_from_python(tmp_path: Path) -> None:
    """One red Gaussian, 4 units in front of the camera, colours the middle of the picture and not its corner."""
    from querysplat_cli import Cameras, read_ply, render, write_ply

    write_ply(tmp_path / "scene.ply", red_gaussians(1))
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    colour = render(read_ply(tmp_path / "scene.ply"), Cameras(torch.eye(4)[None], K, 48, 64)).colour[0]
    assert colour[:, 24, 32].tolist() == pytest.approx([0.97, 0.02, 0.02], abs=0.05)
    assert colour[:, 0, 0].tolist() == [0, 0, 0]
    on_white = render(read_ply(tmp_path / "scene.ply"), Cameras(torch.eye(4)[None], K, 48, 64), background=(1, 1, 1))
    assert on_white.colour[0, :, 0, 0].tolist() == [1, 1, 1]


def test_a_place_is_rendered_too_and_levels_of_detail_are_opened(tmp_path: Path) -> None:
    from querysplat_cli import Cameras, open_scene, render, write_ply
    from querysplat_cli.cli import run

    write_ply(tmp_path / "s.ply", red_gaussians(40))
    assert run(["convert", str(tmp_path / "s.ply"), str(tmp_path / "s.lod"), "-q"]) == 0
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], K, 48, 64)
    for name in ("s.ply", "s.lod"):
        assert len(open_scene(tmp_path / name).gaussians) == 40
        assert render(str(tmp_path / name), cameras).colour.amax() > 0.5


def test_a_scene_is_drawn_however_large_its_units_are(tmp_path: Path) -> None:
    """The splatter's limits are those of the frame in which it was made: a scene in millimetres is not too far."""
    from querysplat_cli import open_scene, render, write_ply

    one = red_gaussians(1)
    write_ply(tmp_path / "s.ply", replace(one, means=one.means * 1000, scales=one.scales * 1000))
    lens = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0}
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1])).tolist()
    frame = {"scale": 1000.0, "rotation": torch.eye(3).tolist(), "translation": [0.0, 0, 0]}
    listing = {"frames": [{"file_path": "a.png", "transform_matrix": pose, **lens}], "working_frame": frame}
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "cameras.json").write_text(json.dumps(listing))
    assert render(open_scene(tmp_path / "s.ply")).colour.amax() > 0.5
