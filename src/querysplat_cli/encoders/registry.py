"""Encoders by name. Each one is imported when it is first asked for."""

from importlib import import_module

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.errors import QuerySplatError

ENCODERS = {
    "classical": ("querysplat_cli.encoders.classical.encoder", "ClassicalEncoder"),
}


def find_encoder(name: str) -> Encoder:
    """The encoder called `name`; raises QuerySplatError, listing the names, when there is none."""
    if name not in ENCODERS:
        raise QuerySplatError(f"there is no encoder named '{name}'", f"Choose one of: {', '.join(sorted(ENCODERS))}.")
    module, maker = ENCODERS[name]
    encoder: Encoder = getattr(import_module(module), maker)()
    return encoder
