"""Weights from files: ours, which carry their configuration, and the official ones under their own names."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from pickle import UnpicklingError

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from querysplat_cli.errors import MissingPart, QuerySplatError
from querysplat_cli.model.config import ModelConfig, preset, preset_names
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.files import atomic_path

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
"""Beginnings of official names and of ours; the first that fits counts."""

OFFICIAL_BLOCK_NAMES = (
    ("gs_self_attn.norm.", "among.norm."),
    ("gs_self_attn.gs_self_attn.proj.", "among.out_proj."),
    ("gs_self_attn.gs_self_attn.", "among."),
    ("gs_self_attn_scale.", "among_scale."),
    ("gs_cross_attn.gs_token_norm.", "cross.norm."),
    ("gs_cross_attn.", "cross."),
    ("gs_cross_attn_scale.", "cross_scale."),
    ("mlp.mlp.", "mlp."),
)
"""The same within a decoder block."""

NAMED = 5
"""How many wrong tensors an error message names."""


def load(name: str) -> QuerySplat:
    """A frozen model from a preset's bundled weights or from a checkpoint file, ready to decode in float32.

    Raises MissingPart when a preset's weights are not here, and QuerySplatError when a file is damaged or
    holds other tensors than the model needs.
    """
    if name in preset_names():
        bundled = resources.files("querysplat_cli") / "weights" / f"{name}.safetensors"
        if not bundled.is_file():
            raise MissingPart(
                f"the weights of preset '{name}' are not part of this package",
                "Use --preset compact, which needs no download, or give a checkpoint file.",
            )
        with resources.as_file(bundled) as path:
            return load_file(path)
    path = Path(name)
    if not path.is_file():
        raise QuerySplatError(f"'{name}' is neither a preset nor a file", f"Presets: {', '.join(preset_names())}.")
    return load_file(path)


def load_file(path: Path) -> QuerySplat:
    """A frozen model from a .safetensors or .pt file, ours or official (told apart by the metadata)."""
    tensors, metadata = read_tensors(path)
    if "config" in metadata:
        config = _stored_config(path, metadata["config"])
    else:
        tensors = {our_name(key): tensor for key, tensor in tensors.items()}
        config = official_config(tensors)
    with torch.device("meta"):
        model = QuerySplat(config)
    check_tensors(model, tensors, str(path))
    model.load_state_dict({key: tensor.float() for key, tensor in tensors.items()}, assign=True)
    return model.requires_grad_(False).eval()


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors by name, and the metadata (empty in a .pt file, of which nothing but tensors is ever executed).

    Raises QuerySplatError when the file is damaged or holds something else.
    """
    try:
        if path.suffix in {".pt", ".pth"}:
            tensors = torch.load(path, map_location="cpu", weights_only=True)
            metadata: dict[str, str] = {}
        else:
            with safe_open(path, framework="pt") as file:
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
                metadata = file.metadata() or {}
    except (SafetensorError, OSError, RuntimeError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise QuerySplatError(
            f"{path} is not a readable checkpoint: {reason}", "Fetch or make the file again."
        ) from error
    if not isinstance(tensors, dict) or not all(isinstance(tensor, Tensor) for tensor in tensors.values()):
        raise QuerySplatError(f"{path} holds other things than named tensors", "Give a file of weights alone.")
    return tensors, metadata


def save(model: QuerySplat, path: Path) -> None:
    """Half-precision weights with the configuration in the metadata, so that one file is enough."""
    tensors = {name: tensor.half().contiguous() for name, tensor in model.state_dict().items()}
    with atomic_path(path) as draft:
        save_file(tensors, draft, metadata={"config": json.dumps(asdict(model.config))})


def _stored_config(path: Path, stored: str) -> ModelConfig:
    try:
        return ModelConfig.from_dict(json.loads(stored))
    except (ValueError, TypeError, AttributeError) as error:
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


def check_tensors(model: torch.nn.Module, tensors: dict[str, Tensor], source: str) -> None:
    """Raises QuerySplatError that names the first missing, unexpected and misshapen tensors."""
    wanted = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    faults = [
        ("missing", sorted(wanted.keys() - tensors.keys())),
        ("unexpected", sorted(tensors.keys() - wanted.keys())),
        (
            "of another shape",
            [
                f"{name} {tuple(tensors[name].shape)} instead of {shape}"
                for name, shape in wanted.items()
                if name in tensors and tuple(tensors[name].shape) != shape
            ],
        ),
    ]
    told = [f"{len(names)} {what} ({_first(names)})" for what, names in faults if names]
    if told:
        raise QuerySplatError(
            f"{source} does not fit the model: tensors {'; '.join(told)}", "It belongs to another model, or is cut off."
        )


def _first(names: list[str]) -> str:
    return ", ".join(names[:NAMED]) + (", …" if len(names) > NAMED else "")


def _replace_beginning(name: str, table: Iterable[tuple[str, str]]) -> str:
    for official, ours in table:
        if name.startswith(official):
            return ours + name[len(official) :]
    return name
