"""Dropout of Gaussians between a few photos."""

from dataclasses import replace

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.tto.dropout import without_some
from querysplat_cli.tto.plan import plan_tto
from querysplat_cli.tto.policy import TTO_POLICY


def test_a_share_is_transparent_and_the_others_make_up_for_it() -> None:
    before = wall(60, size=0.5, opacity=0.5)
    after = without_some(before, 0.2, torch.Generator().manual_seed(0))
    gone = after.opacities == 0
    assert float(gone.float().mean()) == pytest.approx(0.2, abs=0.02)
    torch.testing.assert_close(after.opacities[~gone], torch.full_like(after.opacities[~gone], 0.5 / 0.8))
    assert float(after.opacities.mean()) == pytest.approx(0.5, abs=0.02)
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))


def test_opacities_stay_below_one_and_only_those_shown_have_a_gradient() -> None:
    opacities = torch.tensor([0.3, 0.95]).repeat(200).requires_grad_()
    some = replace(wall(20, size=0.5, opacity=0.5), opacities=opacities)
    after = without_some(some, 0.1, torch.Generator().manual_seed(0))
    assert float(after.opacities.detach().max()) == pytest.approx(0.99)
    after.opacities.sum().backward()
    gone = after.opacities == 0
    assert opacities.grad is not None
    assert bool((opacities.grad[gone] == 0).all())
    assert bool((opacities.grad[0::2][~gone[0::2]] > 1).all())


def test_the_seed_decides_which_are_left_out() -> None:
    some = wall(20, size=0.5, opacity=0.5)
    one, same, other = (without_some(some, 0.3, torch.Generator().manual_seed(seed)).opacities for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(("views", "share"), [(1, 0.0), (2, TTO_POLICY.dropout), (4, TTO_POLICY.dropout), (5, 0.0)])
def test_only_a_few_photos_ask_for_it(views: int, share: float) -> None:
    (run,) = plan_tto(None, views=views, gaussians=1000)
    assert run.settings.dropout == share
