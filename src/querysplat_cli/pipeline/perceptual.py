"""LPIPS in test-time optimisation: with its weights, the loss is the whole one of the paper."""

from functools import lru_cache
from pathlib import Path

from querysplat_cli.splat.lpips import Lpips, find_lpips, load_lpips


@lru_cache(maxsize=2)
def optimisation_lpips(folder: Path | None, *, official: bool) -> Lpips | None:
    """The network that takes part in the loss, or None where it is left out.

    `official` models are optimised with it wherever its weights are, in `folder` or in torch's hub cache, and give it
    pictures as the release does. Other models are optimised with it where `folder` is given: a step of theirs takes
    several times as long then. Raises MissingPart where `folder` lacks a file, and QuerySplatError for a damaged one.
    """
    if folder is None and not official:
        return None
    files = find_lpips(folder)
    return None if isinstance(files, str) else load_lpips(files, as_release=official)
