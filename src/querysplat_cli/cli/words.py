"""Results in words, which several verbs print."""

from collections.abc import Iterator, Sequence
from typing import Any


def decibels(lost: float) -> str:
    """A loss in dB in words, which can be a gain."""
    return f"{abs(lost):.2f} dB {'gained' if round(lost, 2) < 0 else 'lost'}"


def left_out(photos: Sequence[dict[str, Any]]) -> Iterator[str]:
    """One line for photos that were left out; none without any."""
    if photos:
        more = f", and {len(photos) - 1} more" if photos[1:] else ""
        yield f"left out: {photos[0]['name']} ({photos[0]['why']}){more}"
