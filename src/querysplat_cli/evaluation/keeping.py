"""Which pictures of a case are kept beside its scores."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from querysplat_cli.evaluation.judge import RowResult
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.nerfbaselines import write_predictions
from querysplat_cli.evaluation.results import RowFolder
from querysplat_cli.scene.formats.dataset import Frame
from querysplat_cli.scene.pictures import distinct_stems, eight_bit, write_picture

RENDERED, NERFBASELINES = "rendered", "nerfbaselines"
"""Their folders in that of a case."""


@dataclass(frozen=True)
class Keeping:
    """`rendered` keeps the renders, `nerfbaselines` the renders and photos in NerfBaselines' layout."""

    rendered: bool = False
    nerfbaselines: bool = False

    def lacking(self, folders: Iterable[RowFolder]) -> int:
        """How many finished cases were written without pictures that are to be kept."""
        wanted = [name for name, kept in ((RENDERED, self.rendered), (NERFBASELINES, self.nerfbaselines)) if kept]
        if not wanted:
            return 0
        cases = (folder.case(name) for folder in folders for name in folder.done())
        return sum(not all((case / name).is_dir() for name in wanted) for case in cases)

    def writer(
        self, about: Mapping[str, str], truth: Callable[[Frame], Tensor], meter: Meter
    ) -> Callable[[Path, RowResult], None]:
        """The function that writes the pictures of a result into its case's folder."""

        def write(folder: Path, result: RowResult) -> None:
            if self.rendered:
                _write_rendered(folder / RENDERED, result)
            if self.nerfbaselines:
                write_predictions(folder / NERFBASELINES, about, result.views, truth, meter)

        return write


def _write_rendered(folder: Path, result: RowResult) -> None:
    for group, views in result.views.items():
        for view, name in zip(views, distinct_stems([view.frame.name for view in views]), strict=True):
            write_picture(folder / group / f"{name}.png", eight_bit(view.picture))
