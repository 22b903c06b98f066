"""A scene is looked at from the photos' distance, from twice as far and from half as far."""

from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from torch.nn import functional as F

from querysplat_cli.cli import run
from querysplat_cli.pipeline import optimise
from querysplat_cli.pipeline.full_size import files_of
from querysplat_cli.pipeline.scene_folder import read_scene
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.photo_files import large_views
from querysplat_cli.splat.smoothing import sampling
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room
from querysplat_cli.tto import optimise as tto_loop

WORKING = 224


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photos of a procedural room, 448 × 336: twice the working size."""
    folder = tmp_path_factory.mktemp("room") / "photos"
    folder.mkdir()
    room = make_room(3)
    cameras = walk(room, 5, 3)
    for i in range(5):
        picture = (cast(room, cameras[[i]], samples=2)[0][0] * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder


def reconstruct(photos: Path, name: str) -> Path:
    ply = photos.parent / name
    command = ["reconstruct", str(photos), "-o", str(ply), "--holdout-every", "4", "--holdout-cameras", "joint"]
    assert run([*command, "--max-size", str(WORKING), "--tto", "40", "--quiet"]) == 0
    return ply


def decibels(ply: Path) -> list[float]:
    """PSNR of held-out photos at half the working size, at that size and at twice of it, on grey."""
    scene, _ = read_scene(ply)
    assert scene.heldout
    gaussians, (views, cameras) = read_ply(ply), scene.heldout
    double = large_views(files_of(scene, views), views, cameras, 2 * WORKING)
    rows, columns = (size // 2 for size in views.images.shape[2:])
    smaller = replace(
        views,
        images=F.avg_pool2d(views.images[:, :, : 2 * rows, : 2 * columns], 2),
        masks=F.avg_pool2d(views.masks[:, None, : 2 * rows, : 2 * columns].float(), 2)[:, 0] == 1,
        sizes=tuple((height // 2, width // 2) for height, width in views.sizes),
    )
    K = cameras.K.clone()
    K[:, :2] /= 2
    half = smaller, replace(cameras, K=K, height=rows, width=columns)
    return [score(gaussians, *some, 0.5).psnr for some in (half, scene.heldout, double)]


def test_the_bound_holds_in_the_file_and_costs_nothing(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bounded = reconstruct(photos, "bounded.ply")
    scene, _ = read_scene(bounded)
    some = read_ply(bounded)
    assert float((some.scales.amin(1) / sampling(some.means, scene.cameras).least).min()) > 1 - 1e-4
    monkeypatch.setattr(tto_loop, "with_bounded_scales", lambda start, cameras: start)
    monkeypatch.setattr(optimise, "smoothed", lambda gaussians, cameras: gaussians)
    free = reconstruct(photos, "free.ply")
    thin = read_ply(free)
    share = (thin.scales.amin(1) < sampling(thin.means, scene.cameras).least).float().mean()
    print(share, decibels(bounded), decibels(free))
