"""Encoders by name. An encoder is imported when it is first asked for."""

from importlib import import_module

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.errors import QuerySplatError

ENCODERS = ("classical", "vggt", "vggt_omega")
"""Packages beside this file. Each has a module `encoder` with a function `make(options)`."""
DEFAULT_OPTIONS = EncoderOptions()


def find_encoder(name: str, options: EncoderOptions = DEFAULT_OPTIONS) -> Encoder:
    """The encoder called `name`.

    Raises QuerySplatError, which lists the names, when there is none, and MissingPart when its weights are missing.
    """
    if name not in ENCODERS:
        raise QuerySplatError(f"there is no encoder named '{name}'", f"Choose one of: {', '.join(ENCODERS)}.")
    load_pycolmap()  # the module of the encoder imports it, with its handler of SIGTERM
    encoder: Encoder = import_module(f"querysplat_cli.encoders.{name}.encoder").make(options)
    return encoder
