"""Encoders by name. Each one is imported when it is first asked for."""

from importlib import import_module

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.errors import QuerySplatError

ENCODERS = ("classical", "vggt", "vggt_omega")
"""Packages beside this file, each with a function `make` in its module `encoder`."""


DEFAULTS = EncoderOptions()


def find_encoder(name: str, options: EncoderOptions = DEFAULTS) -> Encoder:
    """The encoder called `name`; raises QuerySplatError, listing the names, when there is none.

    Raises MissingPart when its weights are not here.
    """
    if name not in ENCODERS:
        raise QuerySplatError(f"there is no encoder named '{name}'", f"Choose one of: {', '.join(ENCODERS)}.")
    encoder: Encoder = import_module(f"querysplat_cli.encoders.{name}.encoder").make(options)
    return encoder
