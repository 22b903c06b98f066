"""Small samples with true depth, in the cache folder of a training."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import torch

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.checkpoints import preset
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.views import Views
from querysplat_cli.training.config import (
    DataSettings,
    LossSettings,
    OptimiserSettings,
    SourceSettings,
    StageSettings,
    TrainConfig,
)
from querysplat_cli.training.data import CachedSamples, cache_folder
from querysplat_cli.training.passes import Sample, write_sample
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.processes import Processes
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.trainer import Trainer, TrainReport

TINY = replace(preset("compact"), width=120, mlp_ratio=1.0, refinement_rounds=0)


def sample(seed: int, inputs: int = 2, targets: int = 2) -> Sample:
    """Neighbouring views of a room at 72 × 54 pixels; every other one is a target. Features are noise."""
    room = make_room(seed)
    cameras = walk(room, inputs + targets, seed).resized(54, 72)
    images, depth = cast(room, cameras, samples=1)
    rows = list(range(inputs + targets))
    own, other = rows[0 : 2 * inputs : 2], [row for row in rows if row not in rows[0 : 2 * inputs : 2]]
    features = torch.randn(inputs, 9 * 12, 12, generator=torch.Generator().manual_seed(seed))
    views = Views(
        images,
        torch.ones(len(rows), 54, 72, dtype=torch.bool),
        tuple(f"{i}.png" for i in rows),
        ((54, 72),) * len(rows),
    )
    geometry = Geometry(depth[own].clamp_min(0.1), torch.ones(inputs, 54, 72), (features,), 6)
    return Sample(views[own], cameras[own], geometry, views[other], cameras[other])


def training(cache: Path, *, scenes: int = 3, **changes: object) -> TrainConfig:
    """A training of a few steps whose samples are all in `cache`."""
    data = DataSettings(
        (SourceSettings("procedural", scenes=scenes, inputs=(2, 2), targets=2, cameras="posed"),),
        cache=str(cache),
        encoder="classical",
        max_size=72,
    )
    for number in range(scenes):
        path = cache_folder(data, data.sources[0]) / f"{number:06d}-000.safetensors"
        if not path.is_file():
            write_sample(path, sample(number))
    settings: dict[str, object] = {
        "data": data,
        "stages": (StageSettings(steps=6, lr=1e-3),),
        "model": TINY,
        "losses": LossSettings(lpips=0.0, anneal=4, chamfer_points=200, background=0.0),
        "optimiser": OptimiserSettings(precision="fp32", window=4, keep_from=0.0, keep=0.75, ema=0.9),
        "start": "prior",
        "save_every": 2,
        "log_every": 1,
    }
    return TrainConfig(**{**settings, **changes})  # type: ignore[arg-type]


def run(config: TrainConfig, folder: Path, *, resume: bool = False) -> TrainReport:
    """The training on one process of the CPU, whose samples are in its cache."""
    folder.mkdir(exist_ok=True)
    trainer = Trainer(config, folder, Processes(), torch.device("cpu"), resume=resume)
    return trainer.run(CachedSamples(config.data, config.seed), progress=silent)


def toml(config: TrainConfig) -> str:
    """The same training as the text of a TOML file."""
    table = asdict(config)
    lines = [f"{name} = {_value(value)}" for name, value in table.items() if not isinstance(value, dict | tuple)]
    for name in ("model", "losses", "optimiser"):
        lines += [f"[{name}]", *(f"{key} = {_value(value)}" for key, value in table[name].items())]
    lines += ["[data]", *(f"{k} = {_value(v)}" for k, v in table["data"].items() if k != "sources" and v is not None)]
    for source in table["data"]["sources"]:
        lines += ["[[data.sources]]", *(f"{key} = {_value(value)}" for key, value in source.items())]
    for stage in table["stages"]:
        lines += ["[[stages]]", *(f"{key} = {_value(value)}" for key, value in stage.items())]
    return "\n".join(lines) + "\n"


def _value(value: object) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value)
