"""Fixtures of the released arithmetic: inputs, outputs, and weights under their official names."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from querysplat_cli.model.checkpoints import our_name
from querysplat_cli.model.config import ModelConfig
from querysplat_cli.model.querysplat import QuerySplat

import torch
from safetensors.torch import load_file
from torch import Tensor

Tensors = dict[str, Tensor]

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
"""Names of settings in the fixtures, and in our configuration."""
UNNEEDED = {"width": 8, "heads": 1, "geometry_blocks": 1, "appearance_blocks": 1, "query_count": 1, "patch": 1}
"""Sizes of the parts of the model that a unit does not use."""
UNLISTED_INPUTS = ("images", "last_layer")
"""The inputs of a fixture whose description lists none. Where it has none of these tensors, its layers are inputs."""


@dataclass(frozen=True)
class Fixture:
    """One NAME.json with its NAME.safetensors."""

    path: Path
    description: dict[str, Any]
    tensors: Tensors

    @staticmethod
    def read(path: Path) -> "Fixture":
        """From the path of its .json."""
        return Fixture(path, json.loads(path.read_text()), load_file(path.with_suffix(".safetensors")))

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def unit(self) -> str:
        return self.description.get("unit", self.name)

    @property
    def settings(self) -> dict[str, Any]:
        return self.description.get("config", {})

    @cached_property
    def state(self) -> Tensors:
        """Weights by their official names, without the prefix of the part."""
        begins = "state."
        return {name.removeprefix(begins): each for name, each in self.tensors.items() if name.startswith(begins)}

    @property
    def input_names(self) -> list[str]:
        if "inputs" in self.description:
            return [name for name in self.description["inputs"] if name in self.tensors]
        inputs = [name for name in UNLISTED_INPUTS if name in self.tensors]
        return inputs or [name for name in self.tensors if name.startswith("layer_")]

    @property
    def outputs(self) -> Tensors:
        known = self.state.keys() | set(self.input_names)
        unlisted = [name for name in self.tensors if not name.startswith("state.") and name not in known]
        names = self.description.get("outputs", unlisted if "inputs" not in self.description else [])
        return {name: self.tensors[name] for name in names if name in self.tensors}

    @property
    def config(self) -> ModelConfig:
        chosen = {ours: self.settings[theirs] for theirs, ours in CONFIG_NAMES.items() if theirs in self.settings}
        sizes = UNNEEDED | chosen
        layers = len(self.settings.get("mixed_layers", [0]))
        return ModelConfig(**{**sizes, "mixed_layers": layers, "vgm_width": sizes["width"]})

    def model(self) -> QuerySplat:
        """Our model with the weights of the fixture. Parts for which it has none keep their initial weights."""
        # The weights of a fixture for any block are loaded into the first one.
        prefix = self.description.get("official_prefix", "").split(" ")[0].replace("{i}", "0")
        state = {our_name(prefix + name): tensor for name, tensor in self.state.items()}
        torch.manual_seed(0)
        model = QuerySplat(self.config)
        unknown = model.load_state_dict(state, strict=False).unexpected_keys
        if unknown:
            raise KeyError(f"no place in the model for {', '.join(unknown)}")
        return model.requires_grad_(False)

    def scenes(self) -> list[Tensors]:
        """The inputs of each batch item: our classes take one scene."""
        inputs = {name: self.tensors[name] for name in self.input_names}
        batch = len(next(iter(inputs.values()))) if inputs else 1
        return [{name: tensor[i] for name, tensor in inputs.items()} for i in range(batch)]

    def neighbour(self, name: str) -> "Fixture":
        """Another fixture of the same folder."""
        return Fixture.read(self.path.with_name(f"{name}.json"))


def read_fixtures(folder: Path) -> list[Fixture]:
    return [Fixture.read(path) for path in sorted(folder.glob("*.json")) if path.with_suffix(".safetensors").is_file()]
