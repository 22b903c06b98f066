"""Results in words, which several verbs print."""

from collections.abc import Iterator, Sequence
from typing import Any

SHOWN_REASONS = 3
"""Of photos that were left out, in a line for people; reports have all."""


def decibels(lost: float) -> str:
    """A loss in dB in words, which can be a gain."""
    return f"{abs(lost):.2f} dB {'gained' if round(lost, 2) < 0 else 'lost'}"


def left_out(photos: Sequence[dict[str, Any]]) -> Iterator[str]:
    """One line for photos that were left out, with the first photo of each of the first reasons; none without any."""
    firsts: dict[str, str] = {}
    for photo in photos:
        firsts.setdefault(photo["why"], photo["name"])
    shown = [f"{name} ({why})" for why, name in firsts.items()][:SHOWN_REASONS]
    if shown:
        more = f", and {len(photos) - len(shown)} more" if photos[len(shown) :] else ""
        yield f"left out: {', '.join(shown)}{more}"
