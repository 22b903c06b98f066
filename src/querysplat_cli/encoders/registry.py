"""Encoders by name. Each one is imported when it is first asked for."""

import signal
import threading
from importlib import import_module

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.runtime.errors import QuerySplatError

ENCODERS = ("classical", "vggt", "vggt_omega")
"""Packages beside this file, each with a function `make` in its module `encoder`."""


DEFAULTS = EncoderOptions()


def find_encoder(name: str, options: EncoderOptions = DEFAULTS) -> Encoder:
    """The encoder called `name`; raises QuerySplatError, listing the names, when there is none.

    Raises MissingPart when its weights are not here.
    """
    if name not in ENCODERS:
        raise QuerySplatError(f"there is no encoder named '{name}'", f"Choose one of: {', '.join(ENCODERS)}.")
    # pycolmap takes SIGTERM when it is imported, and dies of it with a dump of the stack.
    before = signal.getsignal(signal.SIGTERM)
    encoder: Encoder = import_module(f"querysplat_cli.encoders.{name}.encoder").make(options)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)
    return encoder
