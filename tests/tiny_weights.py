"""Files like the official ones, with small random weights under the official names."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import save_file

from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.vgm import Vgm
from querysplat_cli.encoders.vggt.model import Vggt
from querysplat_cli.encoders.vggt_omega.model import VggtOmega
from querysplat_cli.model.checkpoints import our_name
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.model.querysplat import QuerySplat

WEIGHT_AND_BIAS = {
    "": """patch_embed.proj patch_embed.norm patch_plucker_embed.proj patch_plucker_embed.norm
        vggt_encoder.eye_layer_mlp.0 vggt_encoder.eye_layer_mlp.1 vggt_encoder.eye_layer_mlp.3 vggt_encoder.output_norm
        enc_dec_backbone.encoder_norm enc_dec_backbone.kv_proj enc_dec_backbone.k_proj_norm
        original_encoder_norm original_kv_proj original_k_proj_norm non_rgb_activation_head.deconv
        post_rgb_delta_head""",
    "block": """gs_self_attn.norm gs_self_attn.gs_self_attn.qkv gs_self_attn.gs_self_attn.q_norm
        gs_self_attn.gs_self_attn.k_norm gs_self_attn.gs_self_attn.proj gs_cross_attn.gs_token_norm gs_cross_attn.q_norm
        gs_cross_attn.q_proj gs_cross_attn.out_proj mlp.norm mlp.mlp.fc1 mlp.mlp.fc2""",
}
GAMMAS = ("gs_self_attn_scale.gamma", "gs_cross_attn_scale.gamma", "mlp_scale.gamma")
SMALL = {
    "width": 32,
    "depth": 4,
    "vit_depth": 1,
    "heads": 4,
    "registers": 4,
    "layers": (0, 1, 2, 3),
    "register_blocks": (1,),
    "camera_heads": 4,
    "camera_blocks": 1,
    "depth_channels": 16,
    "depth_levels": (8, 16, 16, 16),
}
OMEGA = VgmConfig(**SMALL)
VGGT = VgmConfig(**{**SMALL, "register_blocks": (), "patch": 14, "pretrained_image": 518})
MODEL = ModelConfig(
    width=64,
    heads=4,
    geometry_blocks=2,
    appearance_blocks=1,
    query_count=24,
    gaussians_per_query=8,
    special_tokens=5,
    vgm_width=64,
)


def official_names(geometry_blocks: int = 12, appearance_blocks: int = 6) -> list[str]:
    """The tensor names of the released checkpoints (docs/reference/official-checkpoint.md); 521 at full size."""
    names = ["vggt_encoder.eye_token", "post_rgb_gs_tokens", "gs_tokens"]
    names += [f"{name}.{part}" for name in WEIGHT_AND_BIAS[""].split() for part in ("weight", "bias")]
    block = [f"{name}.{part}" for name in WEIGHT_AND_BIAS["block"].split() for part in ("weight", "bias")]
    branches = (
        ("enc_dec_backbone.decoder_blocks", geometry_blocks),
        ("post_rgb_decoder_blocks", appearance_blocks),
    )
    for branch, blocks in branches:
        names += [f"{branch}.{i}.{name}" for i in range(blocks) for name in (*block, *GAMMAS)]
    return names


def randomised(module: torch.nn.Module, seed: int) -> dict[str, torch.Tensor]:
    """Its tensors, with everything that starts at nothing redrawn so that each path counts."""
    generator = torch.Generator().manual_seed(seed)
    state = module.state_dict()
    for name, tensor in state.items():
        if name.endswith(("token", "tokens", "queries", "pos_embed")):
            state[name] = torch.randn(tensor.shape, generator=generator)
        elif name.endswith("gamma"):
            state[name] = 0.5 * torch.rand(tensor.shape, generator=generator)
    return state


def write_model(path: Path, config: ModelConfig = MODEL, seed: int = 0) -> QuerySplat:
    """A QuerySplat under official names; sizes other than the official ones are in the metadata."""
    torch.manual_seed(seed)
    model = QuerySplat(config)
    state = randomised(model, seed)
    names = {our_name(name): name for name in official_names(config.geometry_blocks, config.appearance_blocks)}
    stored = {names[name]: tensor.contiguous() for name, tensor in state.items()}
    save_file(stored, path, metadata={"config": json.dumps(asdict(config))})
    model.load_state_dict(state)
    return model.requires_grad_(False)


def write_vgm(path: Path, make: type[Vgm] = VggtOmega, config: VgmConfig = OMEGA, seed: int = 0) -> Vgm:
    """A VGM whose fields of view are about a radian."""
    torch.manual_seed(seed)
    model = make(config)
    state = randomised(model, seed)
    branch = "camera_head.camera_branch.2.bias" if make is VggtOmega else "camera_head.pose_branch.fc2.bias"
    pose = torch.zeros(9)
    pose[6], pose[7:] = 1.0, 1.0 if make is VggtOmega else 0.25
    state[branch] = pose
    state[branch.replace("bias", "weight")] = 0.02 * state[branch.replace("bias", "weight")]
    save_file(state | {"point_head.stranger": torch.zeros(1)}, path, metadata={"config": json.dumps(asdict(config))})
    model.load_state_dict(state)
    return model.requires_grad_(False)


def write_weights(folder: Path) -> Path:
    """All files that the official presets and both encoders read."""
    folder.mkdir(parents=True, exist_ok=True)
    write_model(folder / "querysplat_vggto_1B_512_8192.safetensors")
    write_model(folder / "querysplat_vggto_1B_512_paper.safetensors", ModelConfig(**{**asdict(MODEL), "sh_degree": 0}))
    write_vgm(folder / "vggt_omega_1b_512.safetensors")
    write_vgm(folder / "model.safetensors", Vggt, VGGT)
    return folder
