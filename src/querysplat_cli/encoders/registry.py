"""Encoders by name. An encoder is imported when it is first asked for."""

from collections.abc import Callable

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.registry import Registry

ENCODERS = Registry(
    "encoder",
    "querysplat.encoders",
    {name: f"querysplat_cli.encoders.{name}.encoder:make" for name in ("classical", "vggt", "vggt_omega")},
)
"""Functions `make(options)` that return an `Encoder`."""
MEMBERS = ("name", "size", "own_frame", "estimate_cameras", "estimate_geometry", "free", "bytes_needed")
"""What every encoder has."""
DEFAULT_OPTIONS = EncoderOptions()


def register_encoder(name: str, make: Callable[[EncoderOptions], Encoder]) -> None:
    """Let `--encoder name` and `ReconstructSettings(encoder=name)` use what `make(options)` returns, in this process.

    Raises QuerySplatError where the name is taken.
    """
    ENCODERS.register(name, make)


def find_encoder(name: str, options: EncoderOptions = DEFAULT_OPTIONS) -> Encoder:
    """The encoder called `name`.

    Raises QuerySplatError, which lists the names, when there is none, or when it lacks a member of `Encoder`, and
    MissingPart when its weights are missing.
    """
    load_pycolmap()  # the module of the encoder imports it, with its handler of SIGTERM
    encoder = ENCODERS.find(name)(options)
    if not isinstance(encoder, Encoder):
        lacking = [member for member in MEMBERS if not hasattr(encoder, member)]
        raise QuerySplatError(f"the encoder '{name}' has no {' and no '.join(lacking)}", "See docs/architecture.md.")
    return encoder
