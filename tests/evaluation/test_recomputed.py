"""One set of renders, written in NerfBaselines' layout, and scored again by other code from its files."""

import json
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import torch
from evaluation_scenes import write_room
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from lpips_weights import AFTER, reference, write_weights
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.evaluation.judge import Judge, ViewScore
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.nerfbaselines import write_predictions
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.scene.formats.dataset import Frame, find_scenes
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.lpips import LpipsFiles, find_lpips, load_lpips
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

AGREEMENT = 1e-4
GROUPS = {"input": (0,), "interp": (1, 2), "extrap": (3,)}


def read(file: Path) -> np.ndarray:
    return cv2.imread(str(file))[..., ::-1].astype(np.float64) / 255


def test_scores_agree_with_scikit_image_and_the_layout_of_lpips(tmp_path: Path) -> None:
    """LPIPS is computed by a second implementation, from files as torchvision and the lpips package lay them out."""
    features, linear = write_weights(tmp_path / "weights", "alex")
    files = find_lpips(tmp_path / "weights", "alex")
    assert isinstance(files, LpipsFiles)
    meter = Meter(load_lpips(files))
    generator = torch.Generator().manual_seed(5)
    truths = [torch.rand(3, 64, 80, generator=generator) for _ in range(4)]
    views = {}
    for group, numbers in GROUPS.items():
        pictures = [0.7 * truths[i] + 0.3 * torch.rand(3, 64, 80, generator=generator) for i in numbers]
        frames = [Frame(i, f"frame_{i}.jpg", "", Path(f"frame_{i}.jpg")) for i in numbers]
        views[group] = [
            ViewScore(frame, None, meter.compare(picture, truths[frame.index]), picture)
            for frame, picture in zip(frames, pictures, strict=True)
        ]
    folder = tmp_path / "case" / "nerfbaselines"
    write_predictions(folder, {"row": "free"}, views, lambda frame: truths[frame.index], meter)
    info = json.loads((folder / "info.json").read_text())
    assert (info["method"], info["evaluation_protocol"], info["querysplat"]["row"]) == ("querysplat", "default", "free")
    assert "8 bits" in info["rounding"]
    stored = info["querysplat"]["scores"]
    names = {str(file.relative_to(folder / "color")) for file in (folder / "color").rglob("*.png")}
    assert names == set(stored) == {f"{g}/frame_{i}.png" for g, numbers in GROUPS.items() for i in numbers}
    before = {f"{g}/{Path(view.frame.name).stem}.png": view.scores for g in views for view in views[g]}
    for name, ours in stored.items():
        render, photo = read(folder / "color" / name), read(folder / "gt-color" / name)
        similarity = structural_similarity(
            photo, render, data_range=1, channel_axis=2, gaussian_weights=True, win_size=11
        )
        one, other = (torch.from_numpy(image.copy()).permute(2, 0, 1)[None] for image in (render, photo))
        expected = {
            "psnr": peak_signal_noise_ratio(photo, render, data_range=1),
            "ssim": similarity,
            "lpips": reference(features, linear, AFTER["alex"], one, other),
        }
        assert ours == pytest.approx(expected, abs=AGREEMENT)
        # What rounding to 8 bits changes.
        assert ours["psnr"] == pytest.approx(before[name].psnr, abs=0.02)


@pytest.mark.parametrize("protocol", ["release", "text"])
def test_scores_of_real_renders_agree_with_scikit_image(protocol: Literal["release", "text"], tmp_path: Path) -> None:
    """A scene of two photos of a room, rendered where they were taken, between them and beyond.

    LPIPS by a second implementation from the same files, as above.
    """
    write_room(tmp_path / "room", 6)
    features, linear = write_weights(tmp_path / "weights", "alex")
    files = find_lpips(tmp_path / "weights", "alex")
    assert isinstance(files, LpipsFiles)
    (captured,) = find_scenes([tmp_path / "room"])
    picked = {"input": (0, 3), "interp": (1, 2), "extrap": (4, 5)}
    groups = {group: [captured.frames[i] for i in rows] for group, rows in picked.items()}
    judge = Judge(groups, captured.cameras, Protocol(protocol), Meter(load_lpips(files)))
    room = make_room(3)
    cameras = walk(room, 6, 3)[[0, 3]]
    images, depth = cast(room, cameras, samples=1)
    height, width = images.shape[2:]
    views = Views(images, torch.ones(2, height, width, dtype=torch.bool), ("0", "3"), ((height, width),) * 2)
    result = judge.score_scene(back_project(views, cameras, depth), judge.known, "")
    scored = [view for views in result.views.values() for view in views]
    assert len(scored) == 6
    for view in scored:
        render, photo = (image.double().numpy() for image in (view.picture, judge.truth(view.frame)))
        theirs = structural_similarity(photo, render, data_range=1, channel_axis=0, gaussian_weights=True, win_size=11)
        assert view.scores.ssim == pytest.approx(theirs, abs=AGREEMENT)
        psnr = peak_signal_noise_ratio(photo, render, data_range=1)
        assert view.scores.psnr == pytest.approx(psnr, abs=AGREEMENT)
        assert 10 < psnr < 40
        one, other = (image[None].float() for image in (view.picture, judge.truth(view.frame)))
        lpips = float(reference(features, linear, AFTER["alex"], one, other))
        assert view.scores.lpips == pytest.approx(lpips, abs=AGREEMENT)
    assert min(view.scores.psnr for view in result.views["input"]) > 18
