"""Whether the photos fit: memory estimated before any work is done."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.views import LeftOut, Photo

SHARE = 0.9
"""Of the free memory that a scene may be planned to take."""
RUNTIME = int(0.6 * 2**30)
"""Bytes that the program and its libraries take."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class MemoryNeeds:
    """Two networks, pictures of `size` × `size` pixels, and whether memories are optimised."""

    encoder: Encoder
    model: QuerySplat
    size: int
    optimising: bool = False

    def bytes(self, views: int) -> int | None:
        """About the peak of a scene, weights included; None where the encoder cannot tell.

        The encoder's weights are given back before the decoders start.
        """
        encoding = self.encoder.bytes_needed(views, self.size)
        if encoding is None:
            return None
        special = self.model.config.special_tokens
        decoding = self.model.bytes_needed(views, self.size, special, optimising=self.optimising)
        return RUNTIME + max(encoding + self.model.weight_bytes, decoding)


def within_memory(
    photos: Sequence[Photo], needs: MemoryNeeds, free: int, limit: int | None
) -> tuple[list[Photo], list[LeftOut], int | None]:
    """Evenly spaced photos, at most `limit` and no more than fit into `free` bytes; the others; bytes expected.

    Raises QuerySplatError when not even one fits.
    """
    wanted = min(len(photos), limit or len(photos))
    fitting, needed = wanted, needs.bytes(wanted)
    while needed is not None and needed > SHARE * free and fitting > 0:
        fitting -= 1
        needed = needs.bytes(max(fitting, 1))
    if not fitting:
        raise QuerySplatError(
            f"one view of {needs.size} pixels takes about {(needed or 0) / 2**30:.1f} GiB, {free / 2**30:.1f} are free",
            "Use --precision bf16, a smaller --max-size or fewer --queries.",
        )
    kept = evenly_spaced(photos, fitting)
    names = {photo.name for photo in kept}
    why = f"over the limit of {fitting} views" + ("" if fitting == wanted else f" that {free / 2**30:.1f} GiB hold")
    return kept, [LeftOut(photo.name, why) for photo in photos if photo.name not in names], needed


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """`count` of them, the first and the last included."""
    if count >= len(items):
        return list(items)
    step = (len(items) - 1) / max(count - 1, 1)
    return [items[round(i * step)] for i in range(count)]
