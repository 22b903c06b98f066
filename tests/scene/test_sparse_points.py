"""The triangulated points in a scene folder: written, read, and refused where they are damaged."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.photo_files import PhotoFile
from querysplat_cli.scene.sparse_points import SparsePoints, read_sparse_points, shared_points, write_sparse_points

POINTS = SparsePoints(
    torch.tensor([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
    torch.tensor([[0, 128, 255], [1, 2, 3]], dtype=torch.uint8),
    torch.tensor([0, 0, 1], dtype=torch.int32),
    torch.tensor([0, 1, 1], dtype=torch.int32),
    torch.tensor([[1.5, 2.5], [3.5, 3.5], [5.5, 6.5]]),
)
NAMES = "a.jpg", "b.jpg"
PHOTOS = {"a.jpg": PhotoFile("a.jpg", Path("a.jpg"), (5.0, 5.0), (2.0, 2.0), (0.0, 0.0, 0.0, 0.0), 4, 5)}
"""photos.json does not list the second."""


def test_round_trip(tmp_path: Path) -> None:
    assert read_sparse_points(tmp_path, NAMES, PHOTOS) is None
    write_sparse_points(tmp_path, POINTS)
    found = read_sparse_points(tmp_path, NAMES, PHOTOS)
    assert found is not None
    for name, tensor in vars(POINTS).items():
        torch.testing.assert_close(getattr(found, name), tensor, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"view": torch.tensor([0, 0, 2], dtype=torch.int32)}, "not there"),
        ({"point": torch.tensor([0, -1, 1], dtype=torch.int32)}, "not there"),
        ({"point": torch.tensor([1, 1, 1], dtype=torch.int32)}, "twice"),
        ({"point": torch.tensor([0, 1], dtype=torch.int32)}, "point has another shape"),
        ({"view": torch.tensor([0, 0, 1])}, "view has another"),
        ({"places": torch.full((2, 3), torch.nan)}, "not finite"),
        ({"pixels": torch.tensor([[1.5, 2.5], [3.5, 5.5], [5.5, 6.5]])}, "outside of its photo"),
        ({"pixels": torch.tensor([[-1.5, 2.5], [3.5, 3.5], [5.5, 6.5]])}, "outside of its photo"),
        ({"colours": torch.zeros(2, 3)}, "colours has another"),
        ({"others": torch.zeros(2, 3)}, "other tensors"),
    ],
)
def test_damage_is_refused_by_name(tmp_path: Path, changed: dict[str, torch.Tensor], words: str) -> None:
    (tmp_path / "points.safetensors").write_bytes(save({**vars(POINTS), **changed}))
    with pytest.raises(QuerySplatError, match=words):
        read_sparse_points(tmp_path, NAMES, PHOTOS)


def test_a_cut_file_is_refused(tmp_path: Path) -> None:
    write_sparse_points(tmp_path, POINTS)
    file = tmp_path / "points.safetensors"
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(QuerySplatError, match=r"points\.safetensors"):
        read_sparse_points(tmp_path, NAMES, PHOTOS)


@given(st.lists(st.sets(st.integers(0, 11)), max_size=6))
def test_shared_points_are_those_of_both_views(seen: list[set[int]]) -> None:
    visibility = [torch.tensor(sorted(rows), dtype=torch.int64) for rows in seen]
    common = shared_points(visibility, 12)
    assert common.toarray().tolist() == [[len(one & other) for other in seen] for one in seen]
