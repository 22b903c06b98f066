"""How far our arithmetic is from the released one, unit by unit, on fixtures made by the latter.

    python benchmarks/parity.py ../shared/golden [--json]

A fixture is NAME.json, which names its unit, sizes, inputs and outputs, and NAME.safetensors, which holds
them and the weights (`state.*`, official names). Errors are max|a − b| / max|b|, tensor by tensor, and a
unit is reported with the tensor that comes nearest to its tolerance, or goes furthest beyond it. Exit code
1 when a unit fails; units that this program cannot run are listed as not covered.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from querysplat_cli.model.checkpoints import our_name
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.model.heads import GEOMETRY_CHANNELS, activate_appearance, activate_geometry, assemble
from querysplat_cli.model.memories import Memories, plucker_rays
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import columns, export_rows
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.similarity import RADIUS, photometric_loss, ssim_map, ssim_metric

Tensors = dict[str, Tensor]

TOLERANCES = {"appearance_decoder": 2e-5, "querysplat": 3e-5, "ssim": 2e-5, "ply_export": 1e-6}
TOLERANCE = 1e-5
"""For the units that TOLERANCES does not name."""
LOOSER = {("ssim", "map_same"): 1e-4}
"""Single tensors with a tolerance of their own."""

CONFIG_NAMES = {
    "dim": "width",
    "heads": "heads",
    "mlp_ratio": "mlp_ratio",
    "geometry_depth": "geometry_blocks",
    "appearance_depth": "appearance_blocks",
    "queries": "query_count",
    "gaussians_per_query": "gaussians_per_query",
    "sh_degree": "sh_degree",
    "sh_rest_scale": "sh_rest_scale",
    "scale_cap": "scale_cap",
    "z_offset": "z_offset",
    "patch": "patch",
    "patch_token_start": "special_tokens",
}
"""The fixtures' names of settings, and ours."""
UNNEEDED = {"width": 8, "heads": 1, "geometry_blocks": 1, "appearance_blocks": 1, "query_count": 1, "patch": 1}
"""Small sizes for the parts of the model that a unit does not use."""


@dataclass(frozen=True)
class Fixture:
    """One NAME.json with its NAME.safetensors."""

    name: str
    description: dict[str, Any]
    tensors: Tensors

    @property
    def unit(self) -> str:
        return self.description.get("unit", self.name)

    @property
    def settings(self) -> dict[str, Any]:
        return self.description.get("config", {})

    @property
    def outputs(self) -> Tensors:
        return {name: self.tensors[name] for name in self.description.get("outputs", []) if name in self.tensors}

    @property
    def config(self) -> ModelConfig:
        chosen = {ours: self.settings[theirs] for theirs, ours in CONFIG_NAMES.items() if theirs in self.settings}
        sizes = UNNEEDED | chosen
        layers = len(self.settings.get("mixed_layers", [0]))
        return ModelConfig(**{**sizes, "mixed_layers": layers, "vgm_width": sizes["width"]})

    def model(self) -> QuerySplat:
        """Our model with the fixture's weights under their official names; the rest of it is left as it starts."""
        # Where a fixture serves any block, it is loaded as the first.
        prefix = self.description.get("official_prefix", "").split(" ")[0].replace("{i}", "0")
        state = {
            our_name(prefix + name.removeprefix("state.")): tensor
            for name, tensor in self.tensors.items()
            if name.startswith("state.")
        }
        torch.manual_seed(0)
        model = QuerySplat(self.config)
        unknown = model.load_state_dict(state, strict=False).unexpected_keys
        if unknown:
            raise KeyError(f"no place in the model for {', '.join(unknown)}")
        return model.requires_grad_(False)

    def scenes(self) -> list[Tensors]:
        """The inputs, one batch item at a time: our classes take one scene."""
        inputs = {name: self.tensors[name] for name in self.description.get("inputs", []) if name in self.tensors}
        batch = len(next(iter(inputs.values()))) if inputs else 1
        return [{name: tensor[i] for name, tensor in inputs.items()} for i in range(batch)]


def decoder_block(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    steps = model.geometry_decoder.blocks[0].steps(scene["tokens"], *_memory(scene))
    return dict(zip(("after_cross", "after_self", "out"), steps, strict=True))


def geometry_decoder(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    keys, values = _memory(scene)
    start = torch.cat([model.eye_token, model.geometry_queries])
    after = list(model.geometry_decoder.steps(start, keys, values))
    tokens = model.geometry_tokens(Memories(keys, values, keys, values))
    return {f"after_block_{i}": block for i, block in enumerate(after)} | {"geometry_tokens": tokens}


def appearance_decoder(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    keys, values = _memory(scene)
    start = scene["geometry_tokens"] + model.appearance_queries
    after = list(model.appearance_decoder.steps(start, keys, values))
    tokens = model.appearance_tokens(scene["geometry_tokens"], Memories(keys, values, keys, values))
    raw = model.appearance_head(tokens).reshape(-1, model.config.appearance_channels)
    sh, opacity = activate_appearance(raw, model.config)
    blocks = {f"after_block_{i}": block for i, block in enumerate(after)}
    return {"start_tokens": start, **blocks, "raw": raw, "sh": sh.flatten(1), "opacity": opacity[:, None]}


def geometry_head(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    raw = model.geometry_head(scene["tokens"]).reshape(-1, GEOMETRY_CHANNELS)
    centres, scales, quats = activate_geometry(raw, model.config)
    made = assemble(raw, raw.new_zeros(len(raw), model.config.appearance_channels), model.config)
    return {
        "raw": raw,
        "out": torch.cat([centres, scales, quats], 1),
        "with_z_offset": torch.cat([made.means, made.scales, made.quats], 1),
        "centres": made.means,
        "scales": made.scales,
        "quats": made.quats,
    }


def activations(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    sh, opacity = activate_appearance(scene["raw_appearance"], model.config)
    geometry = torch.cat(activate_geometry(scene["raw_geometry"], model.config), -1)
    return {"geometry": geometry, "sh": sh.flatten(-2), "opacity": opacity[..., None]}


def plucker(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    return {"plucker": plucker_rays(_cameras(scene, *fixture.settings["image_hw"]))}


def layer_mixer(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    tokens = model.layer_mixer(_layers(fixture, scene), model.eye_token)
    keys, values = model.geometry_memory(tokens)
    weights = model.layer_mixer.weights(model.eye_token)
    return {"layer_weights": weights, "memory_tokens": tokens, **_keys_and_values(keys, values)}


def appearance_memory(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    tokens = model.photo_embedding(scene["images"], _cameras(scene, *scene["images"].shape[-2:]))
    return {"tokens": tokens, **_keys_and_values(*model.appearance_memory(tokens))}


def querysplat(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    images = scene["images"]
    memories = model.remember(_layers(fixture, scene), images, _cameras(scene, *images.shape[-2:]))
    made = model.decode(memories)
    parts = [made.means, made.opacities[:, None], made.scales, made.quats, made.sh.flatten(1)]
    return {
        "geometry_tokens": model.geometry_tokens(memories),
        "gaussians": torch.cat(parts, 1),
        "centres": made.means,
        "opacities": made.opacities,
        "scales": made.scales,
        "quats": made.quats,
        "sh": made.sh,
    }


def ssim(fixture: Fixture) -> Tensors:
    a, b = fixture.tensors["a"].clone().requires_grad_(), fixture.tensors["b"]
    inside = (..., slice(RADIUS, -RADIUS), slice(RADIUS, -RADIUS))
    similarity = ssim_map(a, b)
    constant = ssim_map(torch.full_like(b, 0.4), torch.full_like(b, 0.2))
    total = photometric_loss(a, b)
    values = {
        "same": similarity.mean(),
        "valid": similarity[inside].mean(),
        "l1": (a - b).abs().mean(),
        "dssim": (1 - similarity.mean()) / 2,
        "total": total,
        "same_constant": constant.mean(),
        "same_identical": ssim_map(a, a).mean(),
        "valid_constant": constant[inside].mean(),
    }
    return {
        "map_same": similarity,
        "grad_same": torch.autograd.grad(similarity.mean(), a)[0],
        "grad_total": torch.autograd.grad(total, a)[0],
        "metric_skimage": torch.tensor([ssim_metric(*pair) for pair in zip(a.detach(), b, strict=True)]),
        **{name: value[None] for name, value in values.items()},
    }


def ply_export(fixture: Fixture) -> Tensors:
    bands = 3 * (fixture.settings["sh_degree"] + 1) ** 2
    parts = fixture.tensors["gaussians"].flatten(0, -2).split([3, 1, 3, 4, bands], 1)
    centres, opacities, scales, quats, sh = parts
    gaussians = Gaussians(centres, quats, scales, opacities[:, 0], sh.unflatten(1, (-1, 3)))
    names = columns(gaussians.sh_degree)
    rows = export_rows(gaussians, fixture.settings["threshold"])
    return {"rows": rows[:, [names.index(name) for name in fixture.settings["columns"]]]}


BY_SCENE: dict[str, Callable[[Fixture, QuerySplat, Tensors], Tensors]] = {
    "decoder_block": decoder_block,
    "geometry_decoder": geometry_decoder,
    "appearance_decoder": appearance_decoder,
    "geometry_head": geometry_head,
    "activations": activations,
    "plucker_rays": plucker,
    "layer_mixer": layer_mixer,
    "appearance_memory": appearance_memory,
    "querysplat": querysplat,
}
"""Units of the model, which run one scene at a time."""
WHOLE: dict[str, Callable[[Fixture], Tensors]] = {"ply_export": ply_export, "ssim": ssim}
"""Units without weights, which take the fixture as it is."""


def run(fixture: Fixture) -> Tensors:
    """Our outputs for a fixture whose unit is covered."""
    if fixture.unit in WHOLE:
        return WHOLE[fixture.unit](fixture)
    model = fixture.model()
    rows = [BY_SCENE[fixture.unit](fixture, model, scene) for scene in fixture.scenes()]
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def relative_error(ours: Tensor, theirs: Tensor) -> float:
    """max|a − b| / max|b|; infinite for another shape, and where ours is not finite."""
    if ours.shape != theirs.shape:
        return math.inf
    difference = (ours.double() - theirs.double()).abs().max() if theirs.numel() else torch.zeros(())
    size = theirs.double().abs().max() if theirs.numel() else torch.ones(())
    error = float(difference / size) if size > 0 else float(difference)
    return math.inf if math.isnan(error) else error


def compare(fixture: Fixture) -> dict[str, Any]:
    """The result of one unit, as printed; an error that cannot be computed is null, with the reason beside it."""
    tolerance = TOLERANCES.get(fixture.unit, TOLERANCE)
    try:
        ours = run(fixture)
        missing = sorted(fixture.outputs.keys() - ours.keys())
        if missing or not fixture.outputs:
            raise KeyError(f"nothing to compare with {', '.join(missing) or 'our outputs'}")
    except Exception as error:
        return {
            "max_relative_error": None,
            "tolerance": tolerance,
            "ok": False,
            "why": f"{type(error).__name__}: {error}",
        }
    rows = [
        (relative_error(ours[name].detach(), theirs), LOOSER.get((fixture.unit, name), tolerance), name)
        for name, theirs in fixture.outputs.items()
    ]
    error, allowed, name = max(rows, key=lambda row: row[0] / row[1])
    if math.isinf(error):
        return {"max_relative_error": None, "tolerance": allowed, "ok": False, "why": f"{name}: shape, or not finite"}
    return {"max_relative_error": error, "tolerance": allowed, "ok": error <= allowed}


def read_fixtures(folder: Path) -> list[Fixture]:
    return [
        Fixture(path.stem, json.loads(path.read_text()), load_file(path.with_suffix(".safetensors")))
        for path in sorted(folder.glob("*.json"))
        if path.with_suffix(".safetensors").is_file()
    ]


def _memory(scene: Tensors) -> tuple[Tensor, Tensor]:
    """Keys and values [heads, tokens, channels] in our order: tokens first."""
    return scene["keys"].transpose(0, 1), scene["values"].transpose(0, 1)


def _keys_and_values(keys: Tensor, values: Tensor) -> Tensors:
    return {"keys": keys.transpose(0, 1), "values": values.transpose(0, 1)}


def _layers(fixture: Fixture, scene: Tensors) -> list[Tensor]:
    return [scene[f"vgm_layer_{i}"] for i in fixture.settings["mixed_layers"]]


def _cameras(scene: Tensors, height: int, width: int) -> Cameras:
    fx, fy, cx, cy = scene["intrinsics"].unbind(-1)
    K = torch.zeros(len(fx), 3, 3, dtype=fx.dtype)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = fx, fy, cx, cy, torch.ones_like(fx)
    return Cameras(scene["w2c"], K, height, width)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options = parser.parse_args(arguments)
    fixtures = read_fixtures(options.folder)
    if not fixtures:
        parser.error(f"no fixtures (NAME.json with NAME.safetensors) in {options.folder}")
    covered = BY_SCENE.keys() | WHOLE.keys()
    units = {fixture.name: compare(fixture) for fixture in fixtures if fixture.unit in covered}
    not_covered = [fixture.name for fixture in fixtures if fixture.unit not in covered]
    if options.json:
        print(json.dumps({"units": units, "not_covered": not_covered}, indent=1))
    else:
        for name, row in units.items():
            error = row["why"] if row["max_relative_error"] is None else f"{row['max_relative_error']:.1e}"
            print(f"{'ok  ' if row['ok'] else 'FAIL'} {name:22} {error} (tolerance {row['tolerance']:.0e})")
        print(f"not covered: {', '.join(not_covered) or 'none'}")
    return 0 if all(row["ok"] for row in units.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
