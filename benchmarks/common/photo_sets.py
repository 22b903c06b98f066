"""The real photo sets, and whether constants of the package were chosen by their figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Use = Literal["tuned on", "only reported"]
"""Constants are chosen by the figures of sets that are "tuned on". Nothing is chosen by the others any more; some
constants that are older than this division were."""


@dataclass(frozen=True)
class PhotoSet:
    """One set; `folder` of its photos is relative to that of all sets. Of a long one, `count` photos are read."""

    name: str
    use: Use
    folder: str
    count: int | None = None

    def files(self, data: Path) -> list[Path]:
        """All photos of the set, in their order."""
        return sorted((data / self.folder).iterdir())

    def photos(self, data: Path) -> list[Path]:
        """What is reconstructed: the folder, or `count` files at even distances."""
        if self.count is None:
            return [data / self.folder]
        files = self.files(data)
        return [files[round(i * (len(files) - 1) / (self.count - 1))] for i in range(self.count)]


PHOTO_SETS = {
    each.name: each
    for each in (
        PhotoSet("fortress", "tuned on", "fortress/images"),
        PhotoSet("dtu106", "tuned on", "dtu106/images"),
        PhotoSet("sceaux", "only reported", "sceaux/images"),
        PhotoSet("kermit", "tuned on", "kermit/images"),
        PhotoSet("riverview", "only reported", "riverview/images"),
        PhotoSet("fox", "tuned on", "dl3dv/fox/images_4", count=12),
        PhotoSet("highres/sceaux", "only reported", "highres/sceaux"),
        PhotoSet("highres/brighton", "only reported", "highres/brighton"),
        PhotoSet("highres/banana", "only reported", "highres/banana"),
    )
}
USUAL = tuple(name for name in PHOTO_SETS if not name.startswith("highres/"))
"""Names of the sets that a benchmark reads by default."""
