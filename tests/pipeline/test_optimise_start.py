"""What the renders of a new scene are compared with."""

import torch

from querysplat_cli.pipeline.optimise import rendering_target
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import RELEASE
from querysplat_cli.tto.options import OptimiseOptions


def test_official_models_are_optimised_over_the_grey_of_the_release() -> None:
    views = Views(torch.zeros(1, 3, 8, 8), torch.ones(1, 8, 8, dtype=torch.bool), ("a",), ((8, 8),))
    cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], 8, 8)
    official, own = (
        rendering_target(views, cameras, OptimiseOptions(), None, official=official) for official in (True, False)
    )
    assert official.background is not None
    assert official.background.tolist() == [0.5, 0.5, 0.5]
    assert official.settings == RELEASE
    assert (official.backgrounds, official.finest) == (None, None)
    assert own.backgrounds is not None
    assert own.finest is not None
