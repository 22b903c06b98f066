"""The sizes and choices that define a QuerySplat model."""

import tomllib
from dataclasses import dataclass, fields
from importlib import resources
from typing import Any, Literal, get_args, get_origin

from querysplat_cli.runtime.choices import Frame
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.tables import STRICT, from_tables

Refinement = Literal["whole", "no-geometry-memory", "no-appearance-memory", "no-memory", "one-branch"]
GEOMETRY_CHANNELS = 10
"""Raw numbers of the geometry head for each Gaussian: centre 3, scale 3, quaternion 4."""

LARGEST_PATCH = 48
"""Pixels; no picture is smaller."""


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and choices; the defaults are those of the official checkpoints.

    `queries` "learned" takes `query_count` learned tokens and predicts positions in the VGM's frame;
    "anchored" makes a token for each anchor from its `anchor_features` numbers and predicts changes to the
    anchor's prior, whose colours come from the photos. With `branches` "one", a single
    decoder reads both memories. That, and `appearance_blocks` 0, are the paper's ablations. `special_tokens` are the
    camera and register tokens in front of a view's patches; `vgm_width` is the width of the VGM's tokens. `frame` is
    that of a learned VGM's cameras: as it predicts them (the release), or relative to the first view (the paper).
    `refinement_rounds` of feedback follow the decoders of an anchored model (`model/refiner.py`). `refinement` other
    than "whole" is an ablation of these rounds: one or both memories are empty, or one branch reads both.
    """

    __pydantic_config__ = STRICT

    width: int = 2048
    heads: int = 16
    mlp_ratio: float = 4.0
    geometry_blocks: int = 12
    appearance_blocks: int = 6
    branches: Literal["two", "one"] = "two"
    queries: Literal["learned", "anchored"] = "learned"
    query_count: int = 8192
    anchor_features: int = 0
    gaussians_per_query: int = 64
    sh_degree: int = 1
    patch: int = 16
    mixed_layers: int = 4
    special_tokens: int = 17
    vgm_width: int = 2048
    scale_cap: float = 0.075
    z_offset: float = 1.0
    sh_rest_scale: float = 0.1
    frame: Frame = "predicted"
    refinement_rounds: int = 0
    refinement: Refinement = "whole"

    def __post_init__(self) -> None:
        """Raises QuerySplatError when a size is not positive, or the heads do not share the width evenly."""
        sizes = {field.name: getattr(self, field.name) for field in fields(self) if field.type is int}
        may_be_zero = {"appearance_blocks", "anchor_features", "special_tokens", "sh_degree", "refinement_rounds"}
        wrong = [
            name
            for name, size in sizes.items()
            if not isinstance(size, int) or size < 0 or (size == 0 and name not in may_be_zero)
        ]
        wrong += [] if self.scale_cap > 0 else ["scale_cap"]
        if wrong:
            raise QuerySplatError(f"model sizes must be positive: {', '.join(wrong)}", "See docs/method.md.")
        if self.patch > LARGEST_PATCH:
            raise QuerySplatError(f"a patch of {self.patch} pixels is too large", f"Use at most {LARGEST_PATCH}.")
        if self.width % self.heads:
            raise QuerySplatError(f"{self.heads} heads cannot share a width of {self.width}", "Choose a divisor.")
        if self.branches == "one" and self.appearance_blocks:
            raise QuerySplatError("one branch has no appearance_blocks", "Give them to geometry_blocks.")
        if self.refinement_rounds and self.queries != "anchored":
            raise QuerySplatError("refinement_rounds need anchored queries", 'Set queries = "anchored".')
        for field in fields(self):
            value, allowed = getattr(self, field.name), get_args(field.type)
            if get_origin(field.type) is Literal and value not in allowed:
                raise QuerySplatError(f"{field.name} cannot be '{value}'", f"Choose one of: {', '.join(allowed)}.")

    @property
    def sh_bands(self) -> int:
        return (self.sh_degree + 1) ** 2

    @property
    def has_eye(self) -> bool:
        """Whether there is an eye token. It is one more learned query, and gives the weights of several layers."""
        return self.queries == "learned" or self.mixed_layers > 1

    @property
    def appearance_channels(self) -> int:
        """Raw numbers of the appearance head for each Gaussian: SH for three colours, and opacity."""
        return 3 * self.sh_bands + 1

    @property
    def raw_channels(self) -> int:
        """Raw numbers of both heads for each Gaussian."""
        return GEOMETRY_CHANNELS + self.appearance_channels

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "ModelConfig":
        """Raises QuerySplatError when a name is not a field, or a value is of another type."""
        known = {name: value for name, value in values.items() if name != "colour_prior"}  # older files state it
        return from_tables(ModelConfig, known, what="model", docs="docs/method.md")


def preset(name: str) -> ModelConfig:
    """The configuration in presets/NAME.toml; raises QuerySplatError, listing the names, when there is none."""
    folder = resources.files("querysplat_cli") / "presets"
    names = preset_names()
    if name not in names:
        raise QuerySplatError(f"there is no preset named '{name}'", f"Choose one of: {', '.join(names)}.")
    return ModelConfig.from_dict(tomllib.loads((folder / f"{name}.toml").read_text())["model"])


def preset_names() -> list[str]:
    folder = resources.files("querysplat_cli") / "presets"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))
