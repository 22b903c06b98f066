"""Options that benchmarks on real photos share."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from common.locations import PHOTOS, location, missing
from common.photo_sets import PHOTO_SETS, USUAL


class PhotoParser(argparse.ArgumentParser):
    """A parser for the folder of the photo sets, and for `--json`, `--sets` and `--passes` where they are wanted."""

    def __init__(self, doc: str | None, *, json: bool = True, sets: bool = True, passes: bool = True) -> None:
        super().__init__(description=(doc or "").splitlines()[0])
        self.add_argument("data", type=Path, nargs="?", help=f"folder of the photo sets; default: ${PHOTOS}")
        if json:
            self.add_argument("--json", type=Path, help="also write the results here")
        if sets:
            self.add_argument("--sets", nargs="*", choices=PHOTO_SETS, default=USUAL, metavar="SET")
        if passes:
            self.add_argument("--passes", type=Path, help="a folder that keeps what the encoder found")

    def parse(self) -> argparse.Namespace:
        """The options; `data` is a folder that is there."""
        options = self.parse_args()
        if options.data is None:
            options.data = location(PHOTOS)
            reason = missing(PHOTOS)
            if reason:
                self.error(reason)
        return options


@contextmanager
def folder_or_scratch(given: Path | None) -> Iterator[Path]:
    """The folder that was given, or one that is deleted at the end."""
    with TemporaryDirectory() as scratch:
        folder = given or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
