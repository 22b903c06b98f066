"""SuperSplat's own viewer, as npm has it, opens a scene at the view of a photo."""

import shutil
import subprocess
import tarfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from ball import made_gaussians
from chromium import CHROMIUM, PATIENCE, Browser

from querysplat_cli.cli import run
from querysplat_cli.commands.view_server import serving
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.supersplat import write_supersplat
from querysplat_cli.scene.paths import look_at
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm, which fetches SuperSplat's viewer"),
]
PACKAGE = "@playcanvas/supersplat-viewer@1.36.2"
LEAST_PSNR = 24.0


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the viewer's page."""
    folder = tmp_path_factory.mktemp("viewer")
    packed = subprocess.run(["npm", "pack", "--silent", PACKAGE], cwd=folder, capture_output=True, text=True)
    if packed.returncode:
        pytest.skip(f"npm cannot fetch {PACKAGE}: {packed.stderr[-200:]}")
    with tarfile.open(folder / packed.stdout.split()[-1]) as archive:
        archive.extractall(folder, filter="data")
    return folder / "package/public"


def file_of(folder: Path) -> Callable[[str], bytes | None]:
    return lambda name: (folder / name).read_bytes() if (folder / name).is_file() else None


def first_picture(browser: Browser) -> np.ndarray:
    """What the window shows once it shows something and stands still."""
    until, before = time.monotonic() + PATIENCE, browser.screenshot()
    while (np.ptp(before) < 50) or (before != browser.screenshot()).any():
        assert time.monotonic() < until, browser.errors
        time.sleep(1)
        before = browser.screenshot()
    return before


@pytest.mark.parametrize(
    ("content", "size"),
    [("scene.ply", (120, 160)), ("scene.ply", (160, 120)), ("scene.sog", (120, 160)), ("lod-meta.json", (120, 160))],
)
def test_the_first_picture_is_that_of_the_middle_photo(
    content: str, size: tuple[int, int], page: Path, tmp_path: Path
) -> None:
    """`size` is that of photos and window: the viewer takes its angle along the longer side."""
    height, width = size
    K = torch.tensor([[[150.0, 0, width / 2], [0, 150, height / 2], [0, 0, 1]]])
    places = np.array([[-1.0, -1.0, -2.5], [0.2, -1.2, -2.5], [1.5, -0.8, -2.0]])
    cameras = look_at(places, np.zeros(3), np.array([0, -1.0, 0]), Cameras(torch.eye(4)[None], K, height, width))
    site = shutil.copytree(page, tmp_path / "page")
    write_ply(site / "scene.ply", made_gaussians())
    if content == "scene.sog":
        assert run(["convert", str(site / "scene.ply"), str(site / content), "-q"]) == ExitCode.DONE
    if content == "lod-meta.json":
        levels = ["convert", str(site / "scene.ply"), str(site / "scene.lod"), "--levels", "2", "-q"]
        assert run(levels) == ExitCode.DONE
        content = "scene.lod/lod-meta.json"
    write_supersplat(site / "settings.json", made_gaussians(), cameras, (size,) * 3, None)
    with (
        serving(file_of(site), browser=False) as address,
        Browser(tmp_path / "profile", (width, height)) as browser,
    ):
        browser.open(f"{address}index.html?content={content}&noui&noanim&webgl&fullload")
        shown = first_picture(browser) / 255
    renders = render(made_gaussians(), cameras, background=torch.full((3,), MID_GREY)).colour.clamp(0, 1)
    wanted = renders.permute(0, 2, 3, 1).numpy()
    first, middle, last = (float(-10 * np.log10(((shown - each) ** 2).mean())) for each in wanted)
    assert middle > LEAST_PSNR > max(first, last)
