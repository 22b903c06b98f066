"""The encoder and the splatter of the architecture page, in a package outside of this repository."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

PAGE = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text()
RENDER = """
import sys, torch, querysplat_cli as qs
gaussians = qs.read_ply(sys.argv[1])
K = torch.tensor([[[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]])
alpha = qs.render(gaussians, qs.Cameras(torch.eye(4)[None], K, 30, 40), backend="points").alpha
assert 0 < alpha.sum() and set(alpha.unique().tolist()) <= {0.0, 1.0}
"""


def block(language: str, mark: str) -> str:
    found = re.search(rf"^```{language} {mark}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert found
    return found[1]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package as pip would install it: its module, and the entry points of its pyproject.toml."""
    folder = tmp_path_factory.mktemp("site")
    project = tomllib.loads(block("toml", "entry-points"))["project"]
    (folder / "my_splats.py").write_text(block("python", "encoder") + block("python", "splatter"))
    facts = folder / f"my_splats-{project['version']}.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (facts / "entry_points.txt").write_text("".join(groups))
    return folder


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    scene = make_room(3)
    cameras = walk(scene, 7, 3)
    for i in range(4):
        write_picture(folder / f"{i}.png", eight_bit(cast(scene, cameras[[i]], samples=1)[0][0]), [])
    return folder


def run(package: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {"PYTHONPATH": f"{package}:{':'.join(filter(None, sys.path))}", "PATH": "/usr/bin:/bin"}
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False)


def test_an_installed_encoder_makes_a_scene_and_an_installed_splatter_draws_it(
    package: Path, room: Path, tmp_path: Path
) -> None:
    ply = tmp_path / "scene.ply"
    options = ["--encoder", "flat", "--quality", "draft", "--tto", "0", "--max-size", "160"]
    made = run(package, "-m", "querysplat_cli", "reconstruct", str(room), "-o", str(ply), *options)
    assert made.returncode == 0, made.stderr
    assert len(read_ply(ply)) > 100
    drawn = run(package, "-c", RENDER, str(ply))
    assert drawn.returncode == 0, drawn.stderr


def test_without_the_package_the_name_means_nothing(room: Path, tmp_path: Path) -> None:
    made = run(tmp_path, "-m", "querysplat_cli", "reconstruct", str(room), "-o", "no.ply", "--encoder", "flat")
    assert made.returncode == 2
    assert made.stderr.startswith("error: there is no encoder named 'flat'")  # before any photo is read
    assert "classical, vggt, vggt_omega" in made.stderr
