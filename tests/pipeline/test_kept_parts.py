"""Results of a stage in files."""

import resource
from pathlib import Path

import pytest
import torch

from querysplat_cli.encoders.base import Geometry, UsedDepthMaps
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.runtime.errors import QuerySplatError


@pytest.mark.parametrize("room", [2_000, 100_000])
def test_a_full_disk_is_said(tmp_path: Path, room: int) -> None:
    """torch said "unexpected pos", and the run ended as a bug."""
    path, before = tmp_path / "cameras.pt", resource.getrlimit(resource.RLIMIT_FSIZE)
    write_part(path, [torch.ones(2)])
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        with pytest.raises(QuerySplatError, match="the disk is full"):
            write_part(path, [torch.zeros(1_000) for _ in range(50)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert torch.equal(read_part(path)[0], torch.ones(2))
    assert list(tmp_path.iterdir()) == [path]


def test_a_regions_geometry_is_kept_with_what_became_of_its_depth_maps(tmp_path: Path) -> None:
    geometry = Geometry(None, None, (), 8, depth_maps=UsedDepthMaps((0, 2), (2,), 0.01, None))
    write_part(tmp_path / "depth.pt", geometry)
    assert read_part(tmp_path / "depth.pt") == geometry
