"""Known lengths between photos, as the command line gives them."""

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown

BY_GPS = "gps"
BY_DEPTH = "depth"
LONGEST_METRES = 1e7


def read_scale(text: str) -> str:
    """The value of --scale as it was given; raises QuerySplatError when it is none of its kinds."""
    if text not in (BY_GPS, BY_DEPTH):
        lengths(text)
    return text


def lengths(text: str) -> list[tuple[str, str, float]]:
    """Two photos and the metres between them, of each part of a.jpg,b.jpg=1.5;c.jpg,d.jpg=2."""
    found = []
    for part in text.split(";"):
        names, _, length = part.rpartition("=")
        one, _, other = names.partition(",")
        try:
            metres = float(length)
        except ValueError:
            metres = 0.0
        if not (one and other and 0 < metres <= LONGEST_METRES):
            raise QuerySplatError(
                f"--scale {shown(text)}: neither gps, nor depth, nor a distance between two photos",
                "Write gps, depth, or a.jpg,b.jpg=1.5 for 1.5 m between them; separate several by a semicolon.",
            )
        found.append((one.strip(), other.strip(), metres))
    return found
