"""The units of the model, its losses and its files, run on fixtures."""

from collections.abc import Callable

from golden import Fixture, Tensors
from querysplat_cli.model.config import GEOMETRY_CHANNELS
from querysplat_cli.model.decoders import Decoder
from querysplat_cli.model.heads import activate_appearance, activate_geometry, assemble
from querysplat_cli.model.memories import Memories, Memory, plucker_rays
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.fit import centred_crop, normalised
from querysplat_cli.scene.formats.ply import columns, export_rows
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.similarity import RADIUS, photometric_loss, ssim_map, ssim_metric
from querysplat_cli.training.visibility import outside, projected

import torch
from torch import Tensor


def decoder_block(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    block, found = model.geometry_decoder.blocks[0], Tensors()
    block.self_attention.register_forward_pre_hook(lambda _, given: found.update(after_cross=given[0]))
    block.mlp.register_forward_pre_hook(lambda _, given: found.update(after_self=given[0]))
    out = block(scene["tokens"], Memory(*_memory(scene)))
    return {**found, "out": out}


def _after_blocks(decoder: Decoder, tokens: Tensor, memory: Memory) -> Tensors:
    found = {}
    for i, block in enumerate(decoder.blocks):
        tokens = found[f"after_block_{i}"] = block(tokens, memory)
    return found


def geometry_decoder(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    keys, values = _memory(scene)
    start = torch.cat([model.eye_token, model.geometry_queries])
    after = _after_blocks(model.geometry_decoder, start, Memory(keys, values))
    tokens = model.geometry_tokens(Memories(keys, values, keys, values))
    return {**after, "geometry_tokens": tokens}


def appearance_decoder(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    keys, values = _memory(scene)
    start = scene["geometry_tokens"] + model.appearance_queries
    blocks = _after_blocks(model.appearance_decoder, start, Memory(keys, values))
    tokens = model.appearance_tokens(scene["geometry_tokens"], Memories(keys, values, keys, values))
    raw = model.appearance_head(tokens).reshape(-1, model.config.appearance_channels)
    sh, opacity = activate_appearance(raw, model.config)
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
    return {"plucker": plucker_rays(pinholes(scene, *fixture.settings["image_hw"]))}


def layer_mixer(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    tokens = model.layer_mixer(_layers(fixture, scene), model.eye_token)
    keys, values = model.geometry_memory(tokens)
    weights = model.layer_mixer.weights(model.eye_token)
    return {"layer_weights": weights, "memory_tokens": tokens, **_keys_and_values(keys, values)}


def appearance_memory(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    tokens = model.photo_embedding(scene["images"], pinholes(scene, *scene["images"].shape[-2:]))
    return {"tokens": tokens, **_keys_and_values(*model.appearance_memory(tokens))}


def querysplat(fixture: Fixture, model: QuerySplat, scene: Tensors) -> Tensors:
    images = scene["images"]
    cameras = pinholes(scene, *images.shape[-2:])
    memories = model.keys_and_values(model.embed(_layers(fixture, scene), images, cameras))
    tokens = model.geometry_tokens(memories)
    return {"geometry_tokens": tokens, **querysplat_outputs(model.decode(memories))}


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


def preprocess(fixture: Fixture) -> Tensors:
    found = {}
    for name in fixture.input_names:
        photo, number = fixture.tensors[name], name.removeprefix("photo_")
        crop = centred_crop((photo.shape[1], photo.shape[2]), tuple(fixture.settings["image_hw"]))
        picture = crop.picture(photo)
        found |= {
            f"image_{number}": picture,
            f"normalised_{number}": normalised(picture),
            f"crop_hw_{number}": torch.tensor([crop.height, crop.width]),
            f"shift_scale_{number}": torch.tensor([*crop.shift, *crop.scale]),
        }
    return found


def visibility(fixture: Fixture) -> Tensors:
    scenes = fixture.scenes()
    cameras = [pinholes(scene, *fixture.settings["image_hw"]) for scene in scenes]
    found = {
        "means2d": torch.stack([projected(scene["centres"], each) for scene, each in zip(scenes, cameras, strict=True)])
    }
    for name, threshold in fixture.settings["thresholds"].items():
        losses, gradients = [], []
        for scene, each in zip(scenes, cameras, strict=True):
            centres = scene["centres"].clone().requires_grad_()
            losses.append(_visibility_loss(centres, each, float(threshold)))
            gradients += torch.autograd.grad(losses[-1], centres)
        found |= {f"loss_{name}": torch.stack(losses), f"grad_{name}": torch.stack(gradients)}
    return found


def _visibility_loss(centres: Tensor, cameras: Cameras, threshold: float) -> Tensor:
    """TokenGS's own: a centre behind a camera counts as inside where its mirrored projection is inside.

    Distances above `threshold` count as `threshold`; a threshold of 0 means no limit.
    """
    least = outside(centres, cameras).min(0).values
    return (least.clamp_max(threshold) if threshold else least).mean()


def querysplat_outputs(made: Gaussians) -> Tensors:
    """Gaussians by the fixtures' names."""
    parts = [made.means, made.opacities[:, None], made.scales, made.quats, made.sh.flatten(1)]
    return {
        "gaussians": torch.cat(parts, 1),
        "centres": made.means,
        "opacities": made.opacities,
        "scales": made.scales,
        "quats": made.quats,
        "sh": made.sh,
    }


def pinholes(scene: Tensors, height: int, width: int) -> Cameras:
    """Cameras from `w2c` and [fx, fy, cx, cy]."""
    fx, fy, cx, cy = scene["intrinsics"].unbind(-1)
    K = torch.zeros(len(fx), 3, 3, dtype=fx.dtype)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = fx, fy, cx, cy, torch.ones_like(fx)
    return Cameras(scene["w2c"], K, height, width)


def _memory(scene: Tensors) -> tuple[Tensor, Tensor]:
    """Keys and values [heads, tokens, channels] in our order: tokens first."""
    return scene["keys"].transpose(0, 1), scene["values"].transpose(0, 1)


def _keys_and_values(keys: Tensor, values: Tensor) -> Tensors:
    return {"keys": keys.transpose(0, 1), "values": values.transpose(0, 1)}


def _layers(fixture: Fixture, scene: Tensors) -> list[Tensor]:
    return [scene[f"vgm_layer_{i}"] for i in fixture.settings["mixed_layers"]]


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
"""Units of the model: they run one scene at a time."""
WHOLE: dict[str, Callable[[Fixture], Tensors]] = {
    "ply_export": ply_export,
    "preprocess": preprocess,
    "ssim": ssim,
    "visibility_loss": visibility,
}
"""Units without weights: they take the whole fixture."""
