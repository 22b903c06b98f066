"""The units of the two VGMs, and of the way from photos to Gaussians, run on fixtures."""

from collections.abc import Callable
from typing import Any, TypeVar

from golden import Fixture, Tensors
from parity_model import querysplat_outputs
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.pose import decode_pose
from querysplat_cli.encoders.vggt import heads as vggt_heads
from querysplat_cli.encoders.vggt.aggregator import VggtAggregator
from querysplat_cli.encoders.vggt_omega import heads as omega_heads
from querysplat_cli.encoders.vggt_omega.aggregator import OmegaAggregator
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.fit import normalised
from querysplat_cli.scene.rotations import matrix_to_quaternion

import torch
from jaxtyping import Float
from torch import Tensor, nn

CHUNK = 2
"""Views in one chunk: fewer than a fixture has, so that joining chunks is tested."""

CONFIG_NAMES = {
    "dim": "width",
    "depth": "depth",
    "vit_depth": "vit_depth",
    "heads": "heads",
    "storage_tokens": "storage_tokens",
    "register_blocks": "register_blocks",
    "layers": "layers",
    "patch": "patch",
    "pretrained_image": "pretrained_image",
}


def vgm_config(settings: dict[str, Any]) -> VgmConfig:
    chosen = {ours: settings[theirs] for theirs, ours in CONFIG_NAMES.items() if theirs in settings}
    sequences = {name: tuple(value) for name, value in chosen.items() if isinstance(value, list)}
    return VgmConfig(**{**chosen, **sequences, "registers": settings["registers"]})


Part = TypeVar("Part", bound=nn.Module)


def loaded(part: Part, state: Tensors) -> Part:
    part.load_state_dict(state)
    return part.requires_grad_(False)


def omega_aggregator(fixture: Fixture) -> Tensors:
    model = loaded(OmegaAggregator(vgm_config(fixture.settings)), fixture.state)
    patch = model.config.patch
    rotation = model.rotation(*(side // patch for side in fixture.settings["image_hw"]))
    rows = []
    for images in fixture.tensors["images"]:
        vit_tokens, vit_rotation = model.patch_embed.first_tokens(normalised(images))
        tokens = model.first_tokens(images, CHUNK)
        rows.append(
            {
                "vit_after_block_0": model.patch_embed.blocks[0](vit_tokens, vit_rotation),
                "patch_tokens": tokens[:, model.config.special_tokens :],
                "after_frame_block_0": model.frame_blocks[0](tokens, rotation),
            }
            | layers(model, images)
        )
    made = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    flat = {name: each if name.startswith("layer_") else each.flatten(0, 1) for name, each in made.items()}
    return {"rope_sin": rotation.sin, "rope_cos": rotation.cos, **flat}


def layers(model: OmegaAggregator | VggtAggregator, images: torch.Tensor) -> Tensors:
    found = model.layers(images, CHUNK)
    return {f"layer_{i}": layer for i, layer in zip(model.config.layers, found, strict=True)}


def omega_camera_head(fixture: Fixture) -> Tensors:
    settings = fixture.settings
    head = loaded(omega_heads.CameraHead(settings["dim_in"], settings["heads"], settings["blocks"]), fixture.state)
    rows = [head(final[:, : settings["patch_token_start"]]) for final in fixture.tensors["final_layer"]]
    cameras = [decode_pose(row, *settings["image_hw"]) for row in rows]
    return {
        "pose_encoding": torch.stack(rows),
        "w2c": torch.stack([each.w2c[:, :3] for each in cameras]),
        "K": torch.stack([each.K for each in cameras]),
    }


def pose_codec(fixture: Fixture) -> Tensors:
    rows = [omega_heads.activate_pose(raw) for raw in fixture.tensors["raw"]]
    cameras = [decode_pose(row, *fixture.settings["image_hw"]) for row in rows]
    return {
        "pose_encoding": torch.stack(rows),
        "w2c": torch.stack([each.w2c[:, :3] for each in cameras]),
        "K": torch.stack([each.K for each in cameras]),
        "encoded_again": torch.stack([encode_pose(each) for each in cameras]),
    }


def encode_pose(cameras: Cameras) -> Float[Tensor, "views 9"]:
    """What `decode_pose` takes, with a unit quaternion of w ≥ 0. It does not contain the principal point."""
    field = torch.stack([cameras.height / 2 / cameras.K[:, 1, 1], cameras.width / 2 / cameras.K[:, 0, 0]], 1)
    quats = matrix_to_quaternion(cameras.w2c[:, :3, :3])
    quats = torch.where(quats[:, :1] < 0, -quats, quats).roll(-1, 1)
    return torch.cat([cameras.w2c[:, :3, 3], quats, 2 * torch.atan(field)], 1)


def omega_depth_head(fixture: Fixture) -> Tensors:
    settings = fixture.settings
    head = loaded(
        omega_heads.DepthHead(settings["dim_in"], settings["features"], settings["out_channels"]), fixture.state
    )
    batch = fixture.tensors["depth"].shape[0]
    patches = [each.flatten(0, 1) for each in _patches(fixture)]
    grid = _grid(settings)
    levels = head.levels(patches, grid, grid[1] / grid[0])
    fused = head.fuse(levels, (levels[0].shape[-2], levels[0].shape[-1]))
    depth, confidence = (each.unflatten(0, (batch, -1)) for each in head(patches, grid))
    return {
        **{f"level_{i}": level for i, level in enumerate(levels)},
        "fused_4": fused[0],
        "fused_1": fused[-1],
        "depth": depth[..., None],
        "confidence": confidence,
    }


def vggt_aggregator(fixture: Fixture) -> Tensors:
    settings = {"storage_tokens": fixture.settings["registers"], "register_blocks": [], **fixture.settings}
    model = loaded(VggtAggregator(vgm_config(settings)), fixture.state)
    rows = [layers(model, images) for images in fixture.tensors["images"]]
    made = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    return {"patch_tokens": model.patch_embed(normalised(fixture.tensors["images"].flatten(0, 1))), **made}


def vggt_camera_head(fixture: Fixture) -> Tensors:
    settings = fixture.settings
    head = loaded(
        vggt_heads.CameraHead(settings["dim_in"], settings["heads"], settings["blocks"], settings["iterations"]),
        fixture.state,
    )
    rows = [head(last[:, 0]) for last in fixture.tensors["last_layer"]]
    w2c = [decode_pose(row[-1], *settings["image_hw"]).w2c[:, :3] for row in rows]
    return {"pose_encodings": torch.stack(rows, 1), "w2c": torch.stack(w2c)}


def vggt_depth_head(fixture: Fixture) -> Tensors:
    settings = fixture.settings
    head = loaded(
        vggt_heads.DepthHead(settings["dim_in"], settings["patch"], settings["features"], settings["out_channels"]),
        fixture.state,
    )
    rows = [head(each, _grid(settings)) for each in zip(*_patches(fixture), strict=True)]
    depth, confidence = (torch.stack(each) for each in zip(*rows, strict=True))
    return {"depth": depth[..., None], "confidence": confidence}


def pipeline(fixture: Fixture) -> Tensors:
    """Photos to Gaussians. One pass of the VGM finds cameras, depth and features."""
    settings, dense = fixture.settings, fixture.settings["dense"]
    parts = {part: fixture.neighbour(name) for part, name in fixture.description["state_from"].items()}
    config = vgm_config(settings["vggt_omega"])
    width = 2 * config.width
    aggregator = loaded(OmegaAggregator(config), parts["aggregator"].state)
    camera_settings = parts["camera_head"].settings
    camera_head = loaded(
        omega_heads.CameraHead(width, camera_settings["heads"], camera_settings["blocks"]), parts["camera_head"].state
    )
    depth_head = loaded(
        omega_heads.DepthHead(width, dense["features"], dense["out_channels"]), parts["dense_head"].state
    )
    model = Fixture(fixture.path, fixture.description, parts["querysplat"].tensors).model()
    rows = []
    for images in fixture.tensors["images"]:
        found = list(aggregator.layers(images, CHUNK))
        encoding = camera_head(found[-1][:, : config.special_tokens])
        cameras = decode_pose(encoding, *images.shape[-2:])
        depth, confidence = depth_head([each[:, config.special_tokens :] for each in found], _grid(settings))
        memories = model.keys_and_values(model.embed(found, images, cameras))
        lens = [cameras.K[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
        rows.append(
            {
                "pose_encoding": encoding,
                "w2c": cameras.w2c,
                "intrinsics": torch.stack(lens, 1),
                "memory_tokens": model.layer_mixer(found, model.eye_token),
                "depth": depth[:, None],
                "confidence": confidence[:, None],
            }
            | querysplat_outputs(model.decode(memories))
        )
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def _patches(fixture: Fixture) -> list[torch.Tensor]:
    start = fixture.settings["patch_token_start"]
    return [fixture.tensors[f"layer_{i}"][:, :, start:] for i in fixture.settings["layers"]]


def _grid(settings: dict[str, Any]) -> tuple[int, int]:
    height, width = settings["image_hw"]
    return height // settings["patch"], width // settings["patch"]


UNITS: dict[str, Callable[[Fixture], Tensors]] = {
    "pipeline": pipeline,
    "vggt_aggregator": vggt_aggregator,
    "vggt_camera_head": vggt_camera_head,
    "vggt_depth_head": vggt_depth_head,
    "vggt_omega_aggregator": omega_aggregator,
    "vggt_omega_camera_head": omega_camera_head,
    "vggt_omega_depth_head": omega_depth_head,
    "vggt_omega_pose_codec": pose_codec,
}
