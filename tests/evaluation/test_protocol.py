"""Input photos, target photos, and renders through a distorting lens."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.evaluation.protocol import Protocol, photograph
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Photo

LENS = (0.12, -0.08, 0.004, -0.003)


def photo(height: int, width: int) -> Photo:
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return Photo("a.png", Path("a.png"), cv2.GaussianBlur(pixels, (0, 0), 2), focal=300.0)


def camera(height: int, width: int, lens: tuple[float, float, float, float] = LENS) -> PhotoCamera:
    return PhotoCamera(np.eye(4), (0.9 * width, 0.92 * width), (0.52 * width, 0.47 * height), lens, height, width)


def specks(points: np.ndarray, size: float = 0.004) -> Gaussians:
    count = len(points)
    colours = torch.full((count, 1, 3), 0.5 / SH_0)
    return Gaussians(
        torch.from_numpy(points).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), size),
        torch.full((count,), 0.99),
        colours,
    )


@pytest.mark.parametrize(
    ("name", "size", "shown", "scored"),
    [
        ("release", (540, 960), (512, 512), (256, 256)),
        ("release", (480, 270), (270, 270), (256, 256)),
        ("release", (1200, 700), (512, 512), (256, 256)),
        ("text", (540, 960), (256, 455), (540, 960)),
        ("text", (480, 270), (455, 256), (480, 270)),
        ("text", (200, 300), (200, 300), (200, 300)),
    ],
)
def test_sizes(name: str, size: tuple[int, int], shown: tuple[int, int], scored: tuple[int, int]) -> None:
    rules, taken = Protocol(name), photo(*size)  # type: ignore[arg-type]
    assert rules.shown(taken).pixels.shape == (*shown, 3)
    whole = rules.shown(taken).cut_from
    assert whole
    assert whole[0] / whole[1] == pytest.approx(size[0] / size[1], rel=0.01)
    assert min(whole) == min(shown)
    assert rules.truth(taken).shape == (3, *scored)
    lens = rules.shown_camera(camera(*size), taken)
    assert (lens.height, lens.width) == shown
    assert rules.picture(specks(np.array([[0, 0, 2.0]])), lens, taken).shape == (3, *scored)


def test_text_renders_at_the_methods_own_size() -> None:
    """A speck that is finer than a pixel is drawn about a pixel wide: narrower in a render of four times the size."""
    taken, points = photo(512, 768), np.random.default_rng(0).uniform([-0.3, -0.2, 1], [0.3, 0.2, 1], (200, 3))
    scene = specks(points, 0.001)
    lens = Protocol("text").shown_camera(camera(512, 768, (0.0, 0.0, 0.0, 0.0)), taken)
    assert max(lens.height, lens.width) == 384
    pictures = [Protocol("text").picture(scene, lens, taken, own_size=size) for size in (None, 384, 1536)]
    assert {picture.shape for picture in pictures} == {(3, 512, 768)}
    assert torch.equal(pictures[0], pictures[1])
    drawn = [float((picture - 0.5).sum()) for picture in pictures]
    assert 0 < drawn[2] < 0.5 * drawn[0]
    square = Protocol("release").shown_camera(camera(512, 768), taken)
    assert Protocol("release").picture(scene, square, taken, own_size=1536).shape == (3, 256, 256)


@pytest.mark.parametrize("name", ["release", "text"])
def test_the_shown_photo_and_its_camera_agree(name: str) -> None:
    """A mark at a point's projection stays at its projection when photo and camera are cropped and reduced."""
    rules, point = Protocol(name), np.array([[0.05, -0.08, 1.0]])  # type: ignore[arg-type]
    full = camera(1080, 1920)
    taken = Photo("a.png", Path("a.png"), np.zeros((540, 960, 3), np.uint8))
    x, y = _seen(full, point)[0] / 2
    taken.pixels[round(y - 0.5) - 2 : round(y - 0.5) + 3, round(x - 0.5) - 2 : round(x - 0.5) + 3] = 255
    shown, lens = rules.shown(taken), rules.shown_camera(full, taken)
    weights = shown.pixels[..., 0].astype(float)
    rows, columns = np.mgrid[: shown.height, : shown.width] + 0.5
    found = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    np.testing.assert_allclose(found, _seen(lens, point)[0], atol=0.6)  # the mark stands on whole pixels


def test_a_camera_of_another_shape_is_refused() -> None:
    with pytest.raises(QuerySplatError, match="its camera 300 × 200"):
        Protocol("release").shown_camera(camera(200, 300), photo(270, 480))


@pytest.mark.parametrize("lens", [LENS, (0.0, 0.0, 0.0, 0.0), (-0.2, 0.05, 0.0, 0.0)])
def test_specks_are_where_opencv_puts_them(lens: tuple[float, float, float, float]) -> None:
    """OpenCV resamples at 1/32 pixel, so a shift by half a pixel, the usual mistake, would fail."""
    taken = camera(120, 160, lens)
    for point in np.array([[0.0, 0, 1], [0.3, 0.2, 1], [-0.35, 0.1, 1], [0.1, -0.25, 1.0]]):
        picture = photograph(specks(point[None], 0.01), taken)[0].double().numpy() - 0.5
        rows, columns = np.mgrid[:120, :160] + 0.5
        found = np.array([(picture * columns).sum(), (picture * rows).sum()]) / picture.sum()
        np.testing.assert_allclose(found, _seen(taken, point[None])[0], atol=0.08)


def test_pictures_are_over_mid_grey_and_nearly_opaque_as_in_the_release() -> None:
    """gsplat 1.5.3 covers at most 0.999 of a pixel, and the release renders over a grey of 0.5."""
    wall = replace(specks(np.array([[0, 0, 2.0]]), 100.0), opacities=torch.ones(1))
    straight = camera(12, 16, (0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(photograph(wall, straight), 0.999 + 0.001 * 0.5, atol=1e-6)
    np.testing.assert_allclose(photograph(replace(wall, opacities=torch.full((1,), 0.6)), straight), 0.8, atol=1e-4)


def test_a_lens_without_distortion_changes_nothing() -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform([-0.6, -0.5, 1], [0.6, 0.5, 1.5], (300, 3))
    scene = specks(points, 0.03)
    straight = photograph(scene, camera(96, 128, (0.0, 0.0, 0.0, 0.0)))
    nearly = photograph(scene, camera(96, 128, (1e-9, 0.0, 0.0, 0.0)))
    assert float((straight - nearly).abs().max()) < 1e-3


def _seen(lens: PhotoCamera, points: np.ndarray) -> np.ndarray:
    """Projected pixels by OpenCV, moved by half a pixel so that pixel centres are at +0.5."""
    K = np.array([[lens.focal[0], 0, lens.principal[0]], [0, lens.focal[1], lens.principal[1]], [0, 0, 1]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens.distortion))[0][:, 0]
