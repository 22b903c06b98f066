"""The stored scene of tests of scene folders."""

import pytest
from stored_scene import a_stored_scene

from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.scene.gaussians import Gaussians


@pytest.fixture
def stored() -> tuple[StoredScene, Gaussians]:
    return a_stored_scene()
