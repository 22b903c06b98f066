"""Far Gaussians come nearer without looking different from the cameras' middle, and giants become smaller."""

from dataclasses import replace

import torch

from querysplat_cli.prune.far import drawn_in
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import render

COUNT = 1000


def cameras(apart: float) -> Cameras:
    w2c = torch.eye(4).repeat(2, 1, 1)
    w2c[:, 0, 3] = torch.tensor([-apart, apart])
    return Cameras(w2c, torch.tensor([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]).repeat(2, 1, 1), 64, 64)


def scene(far: tuple[float, ...]) -> Gaussians:
    """Most Gaussians 1 to 3 units away, and some at the distances `far`."""
    random = torch.Generator().manual_seed(3)
    distance = 1 + 2 * torch.rand(COUNT, generator=random)
    if far:
        distance[: len(far)] = torch.tensor(far)
    arms = torch.randn(COUNT, 3, generator=random) * 0.2 + torch.tensor([0.0, 0, 1])
    return Gaussians(
        torch.nn.functional.normalize(arms, dim=1) * distance[:, None],
        torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=random), dim=1),
        (torch.rand(COUNT, 3, generator=random) * 0.02 + 0.01) * distance[:, None],
        torch.rand(COUNT, generator=random),
        torch.rand(COUNT, 4, 3, generator=random) - 0.5,
    )


def test_the_view_from_the_middle_is_the_same_and_the_scene_is_smaller() -> None:
    before = scene((5.0, 9.0, 17.0, 40.0))
    after = drawn_in(before, cameras(0.0))
    drawn, expected = (render(each, cameras(0.0)).colour for each in (after, before))
    torch.testing.assert_close(drawn, expected, atol=2e-3, rtol=0)
    near = before.means.norm(dim=1).sort().values[round(PRUNE_POLICY.near_share * COUNT) - 1]
    farthest = float(after.means.norm(dim=1).max())
    assert abs(farthest / float(PRUNE_POLICY.farthest * near) - 1) < 1e-5
    assert torch.equal(before.means.norm(dim=1).argsort()[-10:], after.means.norm(dim=1).argsort()[-10:])


def test_the_near_ones_stay_and_a_second_time_changes_nothing() -> None:
    before = scene((5.0, 9.0, 17.0, 40.0))
    after = drawn_in(before, cameras(0.0))
    near = before.means.norm(dim=1).argsort()[: round(PRUNE_POLICY.near_share * COUNT)]
    for name in ("means", "scales", "quats", "opacities", "sh"):
        assert torch.equal(getattr(before, name)[near], getattr(after, name)[near])
    assert drawn_in(after, cameras(0.0)) is after


def test_giants_become_smaller_and_the_others_do_not() -> None:
    plain = scene(())
    scales = plain.scales.clone()
    scales[3], scales[7, 1] = 9.0, 4.0
    after = drawn_in(replace(plain, scales=scales), cameras(0.0))
    near = plain.means.norm(dim=1).sort().values[round(PRUNE_POLICY.near_share * COUNT) - 1]
    reach = plain.means.norm(dim=1) + 2 * after.scales.amax(1)
    assert (reach <= PRUNE_POLICY.reach * near * 1.001).all()
    torch.testing.assert_close(reach[[3, 7]], (PRUNE_POLICY.reach * near).repeat(2))
    torch.testing.assert_close(after.scales[7, [0, 2]], plain.scales[7, [0, 2]])
    others = [i for i in range(COUNT) if i not in (3, 7)]
    assert torch.equal(after.scales[others], plain.scales[others])
    assert torch.equal(after.means, plain.means)
    assert drawn_in(after, cameras(0.0)) is after


def test_a_scene_in_one_point_stays_as_it_is() -> None:
    point = scene(())[:5]
    point = replace(point, means=torch.zeros_like(point.means))
    assert drawn_in(point, cameras(0.0)) is point


def test_a_scene_without_far_gaussians_stays_as_it_is() -> None:
    for before in (scene(()), scene(())[:1]):
        assert drawn_in(before, cameras(0.3)) is before
