"""What the report of a scene says that nothing changed."""

import pytest
from stored_scene import a_report, a_stored_scene

from querysplat_cli.reporting.omissions import taken_further
from querysplat_cli.tto.adapt import Adapted

SCENE, GAUSSIANS = a_stored_scene()


@pytest.mark.parametrize("stay", [True, False])
def test_the_report_names_bands_that_are_still_left_out(stay: bool) -> None:
    line = {"what": "SH bands", "psnr_lost": 0.01}
    adapted = Adapted(SCENE.memories, GAUSSIANS, SCENE.cameras, ())
    found = taken_further(a_report(left_out=[line])["left_out"], adapted, bands_stay=stay, with_lpips=False)
    assert found == ([line] if stay else [])
