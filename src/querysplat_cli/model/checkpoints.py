"""Weights in files: ours, which include their configuration, and the official ones under their own names."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib import resources
from pathlib import Path

import torch
from safetensors.torch import save as serialised
from torch import Tensor

from querysplat_cli.model.config import ModelConfig, preset, preset_names
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.checkpoint_files import check_tensors, fill, read_tensors
from querysplat_cli.runtime.choices import Precision
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import weight_dtypes
from querysplat_cli.runtime.weight_registry import WEIGHTS, find_weights
from querysplat_cli.scene.files import atomic_path

CPU = torch.device("cpu")

OFFICIAL_NAMES = (
    ("vggt_encoder.eye_token", "eye_token"),
    ("vggt_encoder.eye_layer_mlp.", "layer_mixer.weigh."),
    ("vggt_encoder.output_norm.", "layer_mixer.norm."),
    ("enc_dec_backbone.encoder_norm.", "geometry_memory.norm."),
    ("enc_dec_backbone.kv_proj.", "geometry_memory.proj."),
    ("enc_dec_backbone.k_proj_norm.", "geometry_memory.k_norm."),
    ("enc_dec_backbone.decoder_blocks.", "geometry_decoder.blocks."),
    ("original_encoder_norm.", "appearance_memory.norm."),
    ("original_kv_proj.", "appearance_memory.proj."),
    ("original_k_proj_norm.", "appearance_memory.k_norm."),
    ("post_rgb_decoder_blocks.", "appearance_decoder.blocks."),
    ("post_rgb_gs_tokens", "appearance_queries"),
    ("post_rgb_delta_head.", "appearance_head."),
    ("non_rgb_activation_head.deconv.", "geometry_head."),
    ("patch_embed.proj.", "photo_embedding.colour."),
    ("patch_embed.norm.", "photo_embedding.colour_norm."),
    ("patch_plucker_embed.proj.", "photo_embedding.rays."),
    ("patch_plucker_embed.norm.", "photo_embedding.rays_norm."),
    ("gs_tokens", "geometry_queries"),
)
"""Prefixes of official names and ours in their place. The first prefix that matches is replaced."""

OFFICIAL_BLOCK_NAMES = (
    ("gs_self_attn.norm.", "self_attention.norm."),
    ("gs_self_attn.gs_self_attn.proj.", "self_attention.out_proj."),
    ("gs_self_attn.gs_self_attn.", "self_attention."),
    ("gs_self_attn_scale.", "self_attention_scale."),
    ("gs_cross_attn.gs_token_norm.", "cross.norm."),
    ("gs_cross_attn.", "cross."),
    ("gs_cross_attn_scale.", "cross_scale."),
    ("mlp.mlp.", "mlp."),
)
"""The same for the names within a decoder block."""


def load(
    name: str, weights: Path | None = None, *, precision: Precision = "fp32", device: torch.device = CPU
) -> QuerySplat:
    """A frozen model from a preset or a checkpoint file, ready to decode on `device`.

    Raises what `weights_file` does, and QuerySplatError when a file is damaged or has other tensors than the model.
    """
    with weights_file(name, weights) as path:
        return load_file(path, precision=precision, device=device)


@contextmanager
def weights_file(name: str, weights: Path | None = None) -> Iterator[Path]:
    """The weights of a preset, or the file `name`.

    Those of a preset are bundled, in the folder `weights`, or in the Hugging Face cache. Raises MissingPart when they
    are in none of these, and QuerySplatError when `name` is neither a preset nor a file.
    """
    if name in WEIGHTS and name in preset_names():
        yield find_weights(name, weights)
    elif name in preset_names():
        with resources.as_file(resources.files("querysplat_cli") / "weights" / f"{name}.safetensors") as path:
            yield path
    elif Path(name).is_file():
        yield Path(name)
    else:
        raise QuerySplatError(f"'{name}' is neither a preset nor a file", f"Presets: {', '.join(preset_names())}.")


def load_file(path: Path, *, precision: Precision = "fp32", device: torch.device = CPU) -> QuerySplat:
    """A frozen model from a .safetensors or .pt file under our names or the official ones.

    The configuration is read from the metadata. Without any, it is the official one with the SH degree of the head.
    """
    tensors, metadata = read_tensors(path)
    stored = {our_name(name): name for name in tensors}
    found = {ours: tensors[theirs] for ours, theirs in stored.items()}
    config = _stored_config(path, metadata["config"]) if "config" in metadata else official_config(found)
    with torch.device("meta"):
        model = QuerySplat(config)
    check_tensors(model, found, str(path))
    fill(model, path, stored, weight_dtypes(model, precision), device)
    return model.requires_grad_(False).eval()


def save(model: QuerySplat, path: Path) -> None:
    """Write half-precision weights, with the configuration in the metadata, so that one file is enough."""
    tensors = {name: tensor.half().contiguous() for name, tensor in model.state_dict().items()}
    with atomic_path(path) as draft:
        # Not by save_file: its files can be read by their owner alone.
        draft.write_bytes(serialised(tensors, metadata={"config": json.dumps(asdict(model.config))}))


def _stored_config(path: Path, stored: str) -> ModelConfig:
    try:
        return ModelConfig.from_dict(json.loads(stored))
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise QuerySplatError(f"{path}: its configuration cannot be read: {error}", "Make the file again.") from error


def our_name(official: str) -> str:
    """Our name of an official tensor; names that are not in the table stay as they are."""
    name = _replace_beginning(official, OFFICIAL_NAMES)
    head, found, rest = name.partition(".blocks.")
    if not found:
        return name
    number, _, inner = rest.partition(".")
    return f"{head}.blocks.{number}.{_replace_beginning(inner, OFFICIAL_BLOCK_NAMES)}"


def official_config(tensors: dict[str, Tensor]) -> ModelConfig:
    """The official configuration with the SH degree that the head's shape implies (13·64 rows: degree 1)."""
    config = preset("official-8192")
    head = tensors.get("appearance_head.bias")
    degrees = {(3 * (degree + 1) ** 2 + 1) * config.gaussians_per_query: degree for degree in range(4)}
    rows = 0 if head is None else len(head)
    return ModelConfig(**{**asdict(config), "sh_degree": degrees.get(rows, config.sh_degree)})


def _replace_beginning(name: str, table: Iterable[tuple[str, str]]) -> str:
    for official, ours in table:
        if name.startswith(official):
            return ours + name[len(official) :]
    return name
