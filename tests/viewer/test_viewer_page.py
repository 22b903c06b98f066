"""The viewer's page in a real browser: the pictures are those of our own splatter, and nothing leaves this machine."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ball import made_gaussians
from chromium import CHROMIUM, PATIENCE, Browser

from querysplat_cli.cli import run
from querysplat_cli.commands.live_view import watched
from querysplat_cli.commands.view_server import serving
from querysplat_cli.commands.viewed_scene import viewed_scene
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import write_cameras
from querysplat_cli.scene.paths import look_at
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
SIZE = (120, 160)
LEAST_PSNR = 24.0


def made_cameras() -> Cameras:
    """Three cameras that look down at the ball, rolled, with a principal point away from the middle."""
    K = torch.tensor([[[150.0, 0, 88], [0, 140, 52], [0, 0, 1]]])
    like = Cameras(torch.eye(4)[None], K, *SIZE)
    places = np.array([[-1.0, -1.0, -2.5], [0.2, -1.2, -2.5], [1.5, -0.8, -2.0]])
    return look_at(places, np.zeros(3), np.array([0.2, -1.0, 0.0]), like)


def pictures() -> torch.Tensor:
    return render(made_gaussians(), made_cameras()).colour.clamp(0, 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """scene.ply and scene/ with three photos, which are renders."""
    folder = tmp_path_factory.mktemp("viewed")
    write_ply(folder / "scene.ply", made_gaussians())
    names = ("a.png", "b.png", "c.png")
    views = Views(pictures(), torch.ones(3, *SIZE, dtype=torch.bool), names, (SIZE,) * 3)
    (folder / "scene").mkdir()
    write_cameras(folder / "scene" / "cameras.json", made_cameras(), views)
    for name, image in zip(names, views.images, strict=True):
        write_picture(folder / "scene" / "images" / name, eight_bit(image))
    return folder / "scene.ply"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), (SIZE[1], SIZE[0])) as found:
        yield found


def psnr(picture: np.ndarray, view: int) -> float:
    """Of a screenshot against our own render of an input camera, in dB."""
    wanted = pictures()[view].permute(1, 2, 0).numpy()
    return float(-10 * np.log10(((picture / 255 - wanted) ** 2).mean()))


def without_panel(browser: Browser) -> None:
    browser.settled()
    browser.press("h")
    browser.wait_until(f"document.getElementById('canvas').clientWidth === {SIZE[1]}")
    browser.settled()


def set_control(browser: Browser, name: str, value: float) -> None:
    browser.run(f"((e) => {{ e.value = {value}; e.oninput(); }})(document.getElementById('{name}'))")
    browser.settled()


def test_the_page_shows_what_our_splatter_does(scene: Path, browser: Browser) -> None:
    """First the middle camera, then the others by the arrow key; depth, filters and the photo over the scene."""
    browser.requests.clear()
    with serving(viewed_scene(scene).file, browser=False) as address:
        browser.open(address)
        without_panel(browser)
        middle = browser.screenshot()
        assert psnr(middle, 1) > LEAST_PSNR > psnr(middle, 0)
        browser.press("ArrowRight")
        browser.settled()
        assert psnr(browser.screenshot(), 2) > LEAST_PSNR
        browser.press("ArrowRight")
        browser.settled()
        assert psnr(browser.screenshot(), 0) > LEAST_PSNR
        assert browser.run("document.getElementById('where').textContent") == "1/3 a.png"
        check_controls(browser)
    assert browser.errors == []
    assert {request.split(":")[0] for request in browser.requests} <= {"http", "data", "blob"}
    assert all(request.startswith(address) for request in browser.requests if request.startswith("http"))
    assert len([request for request in browser.requests if request.startswith(address)]) > 10


def check_controls(browser: Browser) -> None:
    set_control(browser, "opacity", 1)
    assert browser.screenshot().max() == 0
    set_control(browser, "opacity", 0)
    set_control(browser, "size", 0.9)
    assert 0 < browser.screenshot().mean() < pictures()[0].mean() * 255
    set_control(browser, "size", 1)
    browser.press("d")
    browser.settled()
    grey = browser.screenshot().astype(int)
    assert np.ptp(grey, axis=2).max() <= 2
    assert grey.max() > 150
    browser.press("d")
    set_control(browser, "blend", 1)
    browser.wait_until("document.getElementById('overlay').complete")
    assert psnr(browser.screenshot(), 0) > LEAST_PSNR


def test_a_drag_leaves_the_photo_and_keeps_the_ball_in_sight(scene: Path, browser: Browser) -> None:
    with serving(viewed_scene(scene).file, browser=False) as address:
        browser.open(f"{address}#3")
        without_panel(browser)
        assert psnr(browser.screenshot(), 2) > LEAST_PSNR
        browser.drag((80, 60), (110, 60))
        browser.settled()
        turned = browser.screenshot()
        assert browser.run("document.getElementById('where').textContent") == "free view"
        assert psnr(turned, 2) < LEAST_PSNR
        assert turned[40:80, 60:100].max(2).mean() > 30
    assert browser.errors == []


def test_a_long_drag_ends_above_the_ground(scene: Path, browser: Browser) -> None:
    """The cameras look down at the ball. A drag that would turn the camera below it ends where further ones change
    nothing; sideways the camera still turns."""
    with serving(viewed_scene(scene).file, browser=False) as address:
        browser.open(f"{address}#1")
        without_panel(browser)
        pictures = []
        for start, end in (((80, 110), (80, 10)), ((80, 110), (80, 60)), ((80, 60), (110, 60))):
            browser.drag(start, end)
            browser.settled()
            pictures.append(browser.screenshot().astype(int))
    assert np.abs(pictures[1] - pictures[0]).mean() < 0.5 < 5 < np.abs(pictures[2] - pictures[1]).mean()


def test_a_drag_right_after_the_panel_went(scene: Path, browser: Browser) -> None:
    """In this window the panel leaves the canvas no width. Whoever takes hold before the next frame sees no scene that
    shrank to a dot."""
    take = """(() => {
        document.body.classList.toggle("bare");
        const send = (kind, x) => canvas.dispatchEvent(new PointerEvent(kind,
            { pointerId: 1, pointerType: "mouse", clientX: x, clientY: 60, button: 0, buttons: 1, bubbles: true }));
        canvas.setPointerCapture = canvas.releasePointerCapture = () => {};
        send("pointerdown", 80);
        send("pointermove", 90);
        send("pointerup", 90);
    })()"""
    with serving(viewed_scene(scene).file, browser=False) as address:
        browser.open(f"{address}#1")
        browser.settled()
        browser.run(take)
        browser.settled()
        assert browser.run("document.getElementById('where').textContent") == "free view"
        assert browser.screenshot()[40:80, 60:100].max(2).mean() > 30
    assert browser.errors == []


def test_the_page_follows_a_run_to_its_end(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two states of a scene, the second with every Gaussian in grey."""
    monkeypatch.setenv("BROWSER", "true")
    monkeypatch.setattr("querysplat_cli.commands.live_view.EVERY_SECONDS", 0.0)
    names = ("a.png", "b.png", "c.png")
    views = Views(pictures(), torch.ones(3, *SIZE, dtype=torch.bool), names, (SIZE,) * 3)
    grey = replace(made_gaussians(), sh=torch.zeros(len(made_gaussians()), 1, 3))
    stages, addresses = Stages(), []
    browser.requests.clear()
    with watched(stages, "room", addresses.append), stages("tto") as progress:
        browser.open(addresses[0])
        progress("loss 0.5", 0.1)
        browser.wait_until("document.getElementById('message').textContent === 'tto: loss 0.5'")
        progress.look(made_gaussians(), views, made_cameras())
        without_panel(browser)
        assert psnr(browser.screenshot(), 1) > LEAST_PSNR
        progress.look(grey, views, made_cameras())
        browser.wait_until("performance.getEntriesByType('resource').some(e => e.name.endsWith('scene.ply?2'))")
        browser.settled()
        until = time.monotonic() + PATIENCE
        while np.ptp(browser.screenshot().astype(int), axis=2).max() > 2:
            assert time.monotonic() < until, "the page does not show the second state"
            browser.settled()
    browser.wait_until("document.getElementById('state').textContent.startsWith('The run has ended')")
    assert browser.errors == []
    assert all(request.startswith((addresses[0], "data:", "blob:")) for request in browser.requests)


def test_the_exported_file_opens_from_disk(scene: Path, browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "shared.html"
    assert run(["export", str(scene), "-o", str(page), "--quiet"]) == 0
    browser.requests.clear()
    browser.open(page.as_uri())
    without_panel(browser)
    assert psnr(browser.screenshot(), 1) > LEAST_PSNR
    assert browser.run("document.getElementById('photo').naturalWidth") == SIZE[1]
    assert browser.errors == []
    assert {request.split(":")[0] for request in browser.requests} <= {"file", "data", "blob"}
    assert [request for request in browser.requests if request.startswith("file")] == [page.as_uri()]
