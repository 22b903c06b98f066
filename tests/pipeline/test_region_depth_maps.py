"""What became of the depth maps of regions, all together."""

import pytest

from querysplat_cli.encoders.base import UsedDepthMaps
from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.pipeline.regions.join import depth_maps_of_all


@pytest.mark.parametrize(
    ("units", "common"),
    [((2.0, 2.0625), 2.03125), ((2.0, 2.5), None), ((2.0, None), None), ((None, 2.0), None)],
)
def test_depth_maps_of_regions_have_one_unit_where_theirs_hardly_differ(
    units: tuple[float | None, float | None], common: float | None
) -> None:
    groups = Group((0, 3), (1,)), Group((1, 2), (0,))
    one, other = (UsedDepthMaps((0, 1, 2), (0, 2), 0.01, unit) for unit in units)
    assert depth_maps_of_all(groups, [None, None]) is None
    assert depth_maps_of_all(groups, [one, other]) == UsedDepthMaps((0, 3, 1, 2), (0, 1), 0.01, common)
    unused = UsedDepthMaps((0, 1), (), None, None)
    assert depth_maps_of_all(groups, [one, unused]) == UsedDepthMaps((0, 3, 1, 2), (0,), 0.01, units[0])
    assert depth_maps_of_all(groups, [unused, None]) == UsedDepthMaps((0, 3), (), None, None)
