"""Transients of regions in the scene that these become."""

from pathlib import Path

import pytest
import torch

from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.pipeline.regions.join import hide_transients
from querysplat_cli.scene.filed_views import FiledViews
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.scene.views import Views


@pytest.mark.parametrize("filed", [False, True])
def test_what_a_region_hides_is_hidden_in_the_whole(filed: bool, tmp_path: Path) -> None:
    """The photo in the middle is in both regions; each hides a row of it, and one pixel is in both rows."""
    shown = torch.ones(3, 4, 5, dtype=torch.bool)
    shown[0, 3] = False  # padding
    views: Views = Views(torch.rand(3, 3, 4, 5), shown.clone(), ("a", "b", "c"), ((3, 5), (4, 5), (4, 5)))
    views = FiledViews(views, tmp_path / "all.views") if filed else views
    first, second = torch.zeros(2, 4, 5, dtype=torch.bool)
    first[2], second[:, 4] = True, True
    groups = Group((0,), (1,)), Group((2,), (1,))
    found = hide_transients(views, groups, [{1: first}, {1: second}])
    assert found == MaskedShare(photos=1, share=8 / 55)
    assert torch.equal(views.masks, torch.stack([shown[0], ~first & ~second, shown[2]]))
