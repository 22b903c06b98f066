"""A small stored scene."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.reporting.report import Report
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.sparse_points import SparsePoints
from querysplat_cli.scene.views import PhotoSource, Views

HEIGHT, WIDTH = 24, 36


def views(names: tuple[str, ...], seed: int) -> tuple[Views, Cameras]:
    """Pictures of two sizes on one canvas, with colours that 8 bits hold exactly."""
    count = len(names)
    generator = torch.Generator().manual_seed(seed)
    sizes = tuple((HEIGHT, WIDTH - 12 * (i % 2)) for i in range(count))
    images, masks = torch.zeros(count, 3, HEIGHT, WIDTH), torch.zeros(count, HEIGHT, WIDTH, dtype=torch.bool)
    for i, (height, width) in enumerate(sizes):
        images[i, :, :height, :width] = torch.randint(0, 256, (3, height, width), generator=generator) / 255
        masks[i, :height, :width] = True
    masks[0, :2] = False
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, :3, 3] = torch.randn(count, 3, generator=generator)
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 41, HEIGHT / 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Views(images, masks, names, sizes), Cameras(w2c, K, HEIGHT, WIDTH)


def a_stored_scene() -> tuple[StoredScene, Gaussians]:
    inputs, cameras = views(("a.png", "sub/b.png", "c.webp"), 0)
    heldout = views(("d.png",), 1)
    depth = torch.full(inputs.masks.shape, 3.0)
    anchors, _ = build_anchors(inputs, cameras, Geometry(depth, torch.ones_like(depth), (), 6))
    generator = torch.Generator().manual_seed(2)
    geometry, appearance = (1 + int(near.index.max()) for near in (anchors.geometry, anchors.appearance))
    rows = (geometry, geometry, appearance + 1, appearance + 1)
    memories = Memories(*(torch.randn(count, 2, 3, generator=generator) for count in rows))
    gaussians = Gaussians(
        torch.randn(7, 3, generator=generator) + torch.tensor([0.0, 0, 4]),
        torch.nn.functional.normalize(torch.randn(7, 4, generator=generator), dim=-1),
        torch.rand(7, 3, generator=generator) + 0.01,
        torch.rand(7, generator=generator) * 0.9 + 0.05,
        torch.randn(7, 4, 3, generator=generator),
    )
    lens = PhotoCamera(np.eye(4), (40.0, 41.0), (18.0, 12.0), (0.1, 0.0, 0.0, 0.0), HEIGHT, WIDTH)
    photos = {name: PhotoFile.of(name, PhotoSource(Path("/photos") / name), lens) for name in ("a.png", "d.png")}
    exposures = Exposures(Exposures.identity(3).matrices * torch.tensor([0.9, 1.0, 1.1])[:, None, None])
    scene = StoredScene(inputs, cameras, heldout, memories, anchors, "compact", photos=photos, exposures=exposures)
    points = SparsePoints(
        torch.rand(2, 3), torch.zeros(2, 3).byte(), torch.zeros(2).int(), torch.arange(2).int(), torch.rand(2, 2)
    )
    return replace(scene, points=points), gaussians


def a_report(**changes: Any) -> dict[str, Any]:
    """A report with every entry that a later run reads."""
    run = {
        "space": "features", "steps": 3, "seconds": None, "loss_before": 0.2, "loss_after": 0.1, "cameras": None,
        "added": 0, "undone": 0, "interrupted": False, "curve": [],
    }  # fmt: skip
    settings = {"queries": None, "weights": None, "precision": "fp32"}
    report = Report(
        ply="s.ply", scene="s", views={"used": ["a.png"], "left_out": [{"name": "x.png", "why": "it is empty"}]},
        gaussians=7, seconds={"total": 1.0}, quality={}, left_out=[], warnings=[], tto=[run], settings=settings,
        peak_memory_gib=0.5, machine="a machine",
    )  # fmt: skip
    return {**report.as_dict(), **changes}
