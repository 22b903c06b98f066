"""Files of colour transforms: read as they were written, and refused where they are damaged."""

import json
from pathlib import Path

import pytest
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.exposures import Exposures, read_exposures, write_exposures


def test_files(tmp_path: Path) -> None:
    file, names = tmp_path / "exposures.json", ("a", "b", "c", "d")
    gains = torch.tensor([0.8, 0.9, 1.1, 1.2], dtype=torch.float64)[:, None, None]
    some = Exposures(gains * Exposures.identity(4).matrices + 0.02)
    assert read_exposures(file, names) is None
    write_exposures(file, names, some)
    found = read_exposures(file, names[::-1])
    assert found
    assert torch.equal(found.matrices, some.matrices.flip(0))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([], "a name and a matrix for each photo"),
        ([{"name": "a", "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}], "3 × 4"),
        ([{"name": "a", "matrix": [[1, 0, 0, float("nan")], [0, 1, 0, 0], [0, 0, 1, 0]]}], "finite"),
        ([{"name": "a", "matrix": [[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}], "inverted"),
        ([{"name": "a", "matrix": [[1, 1e30, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}], "no exposure's"),
        ([{"name": "a", "matrix": [[1e300] * 4, [-1e300] * 4, [1e300, 0, 0, 0]]}], "no exposure's"),
    ],
)
def test_damaged_files(entries: list[dict[str, object]], message: str, tmp_path: Path) -> None:
    file = tmp_path / "exposures.json"
    file.write_text(json.dumps({"photos": entries}))
    with pytest.raises(QuerySplatError, match=message):
        read_exposures(file, ("a",))
