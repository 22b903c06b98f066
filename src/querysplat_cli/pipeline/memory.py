"""How many photos fit into memory, estimated before any work is done."""

from collections.abc import Sequence
from dataclasses import dataclass

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.views import LeftOut, Photo


@dataclass(frozen=True)
class MemoryNeeds:
    """What the memory of a scene depends on: two networks, pictures of `size` × `size` pixels, and optimisation."""

    encoder: Encoder
    model: QuerySplat
    size: int
    optimising: bool = False

    def bytes(self, views: int) -> int | None:
        """About the peak of a scene of so many views, weights included; None where the encoder has no estimate.

        The encoder's weights are freed before the decoders start.
        """
        encoding = self.encoder.bytes_needed(views, self.size)
        if encoding is None:
            return None
        special = self.model.config.special_tokens
        decoding = self.model.bytes_needed(views, self.size, special, optimising=self.optimising)
        return PIPELINE_POLICY.program_bytes + max(encoding + self.model.weight_bytes, decoding)


def within_memory(
    photos: Sequence[Photo], needs: MemoryNeeds, free: int, limit: int | None
) -> tuple[list[Photo], list[LeftOut], int | None]:
    """Choose evenly spaced photos, at most `limit` and no more than fit into `free` bytes.

    Returns the chosen photos, the others, and the bytes expected. Raises QuerySplatError when not even one fits.
    """
    wanted = min(len(photos), limit or len(photos))
    fitting, needed = wanted, needs.bytes(wanted)
    while needed is not None and needed > PIPELINE_POLICY.memory_share * free and fitting > 0:
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
