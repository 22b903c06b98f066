"""Sound files for `abuse.py` to damage. Everything is repeatable from a seed."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

from querysplat_cli.cli import run
from querysplat_cli.prune.merging import halved
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.formats.colmap import write_colmap
from querysplat_cli.scene.formats.compressed import write_spz
from querysplat_cli.scene.formats.gltf import write_glb
from querysplat_cli.scene.formats.lod_tree import divided
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.sog import write_sog
from querysplat_cli.scene.formats.streamed_sog import Level, write_streamed
from querysplat_cli.scene.formats.transforms import read_transforms, write_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sparse_points import NAME, SparsePoints, write_sparse_points
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.solids import Scene

import av
import cv2
import numpy as np
import torch

TRAINING = """start = "scratch"
seed = 0
save_every = 2
log_every = 1
[model]
width = 64
heads = 4
mlp_ratio = 1.0
geometry_blocks = 1
appearance_blocks = 1
query_count = 32
gaussians_per_query = 4
patch = 6
mixed_layers = 1
special_tokens = 0
vgm_width = 12
[data]
cache = "passes"
encoder = "classical"
max_size = 96
[[data.sources]]
kind = "procedural"
scenes = 1
size = [90, 96]
inputs = [2, 2]
targets = 1
cameras = "posed"
[[stages]]
steps = 12
lr = 1e-3
queries = 32
inputs = [2, 2]
[losses]
lpips = 0.0
chamfer_points = 256
[optimiser]
precision = "fp32"
"""
"""The smallest training: a procedural scene of three photos."""


@dataclass(frozen=True)
class Sound:
    """A folder of sound files: a scene, photos, cameras, every kind of Gaussians."""

    folder: Path

    @property
    def photos(self) -> Path:
        """Pictures of a room: 0.png and 1.png."""
        return self.folder / "photos"

    @property
    def captured(self) -> Path:
        """A captured scene without cameras: 40 pictures of noise."""
        return self.folder / "captured"

    @property
    def room(self) -> Path:
        """A captured scene with cameras: a few small pictures of a room."""
        return self.folder / "room"

    def bytes(self, name: str) -> bytes:
        return (self.folder / name).read_bytes()

    def scene(self, target: Path) -> None:
        """A copy of the scene, as s.ply and s/."""
        shutil.copy(self.folder / "s.ply", target / "s.ply")
        shutil.copytree(self.folder / "s", target / "s")

    def points(self) -> Path:
        """A points.safetensors that fits the scene: 20 points that its only photo observes."""
        generator = torch.Generator().manual_seed(0)
        places, pixels = torch.randn(20, 3, generator=generator), 70 * torch.rand(20, 2, generator=generator)
        rows = torch.arange(20, dtype=torch.int32)
        points = SparsePoints(places, torch.zeros(20, 3, dtype=torch.uint8), torch.zeros_like(rows), rows, pixels)
        write_sparse_points(self.folder, points)
        return self.folder / NAME


def make(folder: Path) -> None:
    """Write the sound files."""
    _photos(folder / "photos", make_room(3), 2)
    made = ["reconstruct", str(folder / "photos" / "0.png"), "-o", str(folder / "s.ply"), "--max-size", "96", "-q"]
    assert run([*made, "--tto", "1"]) == 0
    assert run(["convert", str(folder / "s" / "cameras.json"), str(folder / "transforms.json"), "-q"]) == 0
    few = gaussians(20)
    for write, name in ((write_ply, "few.ply"), (write_spz, "few.spz"), (write_sog, "few.sog"), (write_glb, "few.glb")):
        write(folder / name, few)
    _streamed(folder / "few.lod", few)
    listed = read_transforms(folder / "transforms.json")
    for text in (False, True):
        place = folder / ("text" if text else "binary")
        place.mkdir()
        write_colmap(place, listed, text=text)
    pictures = folder / "captured" / "images"
    pictures.mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    for i in range(40):
        cv2.imwrite(str(pictures / f"{i}.png"), np.roll(pixels, i))
    _captured_room(folder / "room")
    write_film(folder / "film.mp4")


def _streamed(folder: Path, gaussians: Gaussians) -> None:
    """A streamed SOG of two levels in several chunks, with a tree and an environment."""
    body = gaussians[torch.arange(len(gaussians)) < 16]
    division, leaf = divided(body.means.double().numpy(), 4)
    finest = Level(body, torch.from_numpy(leaf))
    folder.mkdir()
    levels = [finest, Level(*halved(finest.gaussians, finest.leaf))]
    write_streamed(folder, levels, division, gaussians[torch.arange(len(gaussians)) >= 16], chunk=8)


def _photos(folder: Path, scene: Scene, count: int) -> Cameras:
    """Write photos 0.png, 1.png, … of a procedural scene. Returns their cameras."""
    cameras = walk(scene, count, 3)
    folder.mkdir(parents=True)
    for i in range(count):
        picture = (cast(scene, cameras[[i]], samples=1)[0][0] * 255).byte().permute(1, 2, 0).numpy()
        cv2.imwrite(str(folder / f"{i}.png"), picture[..., ::-1])
    return cameras


def _captured_room(folder: Path) -> None:
    """Photos, their cameras, and a split of two inputs and one target."""
    cameras = _photos(folder / "images", make_room(3), 4)
    names = [f"{i}.png" for i in range(4)]
    poses = zip(cameras.w2c.double().numpy(), cameras.K.double().numpy(), strict=True)
    pinholes = [PhotoCamera.pinhole(w2c, K, cameras.height, cameras.width) for w2c, K in poses]
    write_transforms(folder / "transforms.json", dict(zip(names, pinholes, strict=True)))
    views = [{"path": f"d/images/{name}", "frame_index": i} for i, name in enumerate(names)]
    sample = {"scene_id": "room", "input_views": views[0:3:2], "interp_views": views[1:2], "extrap_views": []}
    whole = {"dataset_path": "d", "total_samples": 1, "num_input_views": 2, "scale": "small", "samples": [sample]}
    (folder / "split.json").write_text(json.dumps(whole))


def write_film(path: Path) -> None:
    """An .mp4 of 20 pictures of a camera that pans over smooth noise."""
    noise = np.random.default_rng(0).integers(0, 256, (24, 60, 3), dtype=np.uint8)
    whole = cv2.resize(noise, (360, 144), interpolation=cv2.INTER_CUBIC)
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 192, 144, "yuv420p"
        for i in range(20):
            picture = np.ascontiguousarray(whole[:, 8 * i : 8 * i + 192])
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        film.mux(stream.encode())


def gaussians(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    normal = [torch.randn(count, *shape, generator=generator) for shape in ((3,), (4,), (3,), (), (4, 3))]
    return Gaussians(normal[0], normal[1], (normal[2] - 3).exp(), normal[3].sigmoid(), normal[4])
