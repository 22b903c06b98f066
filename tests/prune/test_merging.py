"""Coarser levels of detail: what is merged, and that it looks the same."""

from dataclasses import replace

import torch

from querysplat_cli.prune.merging import halved
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.paths import surround
from querysplat_cli.splat.render import render


def cloud(count: int, seed: int = 0) -> Gaussians:
    """A plane of Gaussians with colours that change slowly."""
    chance = torch.Generator().manual_seed(seed)
    means = torch.cat([torch.rand(count, 2, generator=chance) * 2 - 1, torch.zeros(count, 1)], 1)
    return Gaussians(
        means,
        torch.randn(count, 4, generator=chance),
        0.06 + 0.03 * torch.rand(count, 3, generator=chance),
        0.3 + 0.5 * torch.rand(count, generator=chance),
        torch.sin(2 * means)[:, None],
    )


def test_two_equal_gaussians_become_one_that_covers_both() -> None:
    """By moments: centre in the middle, variance of the pair along their line, colour between the two."""
    two = Gaussians(
        torch.tensor([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4),
        torch.full((2, 3), 0.1),
        torch.full((2,), 0.2),
        torch.tensor([[[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]]),
    )
    one, leaf = halved(two, torch.zeros(2, dtype=torch.long))
    assert leaf.tolist() == [0]
    torch.testing.assert_close(one.means, torch.zeros(1, 3), atol=1e-7, rtol=0)
    torch.testing.assert_close(one.sh, torch.full((1, 1, 3), 0.5))
    torch.testing.assert_close(one.scales.sort().values, torch.tensor([[0.1, 0.1, 0.1 * 2**0.5]]))
    # 3 faces of area 1 each become 1 + 2·√2; mass is opacity times these.
    torch.testing.assert_close(one.opacities, torch.tensor([2 * 0.2 * 3 / (1 + 2 * 2**0.5)]).clamp(max=0.36))


def test_the_faint_and_the_like_go_first() -> None:
    """Of three neighbours, the two of one colour are merged; beside an opaque one, a faint one is taken up."""
    scene = cloud(3)
    scene = replace(scene, means=torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]), opacities=torch.full((3,), 0.5))
    sizes = torch.full((3, 3), 0.05)
    coloured = replace(scene, scales=sizes, sh=torch.tensor([0.0, 2.0, 2.0])[:, None, None].expand(3, 1, 3))
    found, _ = halved(coloured, torch.zeros(3, dtype=torch.long))
    assert sorted(found.sh[:, 0, 0].tolist()) == [0.0, 2.0]
    faint = replace(coloured, opacities=torch.tensor([0.5, 0.001, 0.5]))
    found, _ = halved(
        replace(faint, sh=torch.tensor([0.0, 1.0, 2.0])[:, None, None].expand(3, 1, 3)), torch.zeros(3).long()
    )
    assert sorted(round(value, 1) for value in found.sh[:, 0, 0].tolist()) == [0.0, 2.0]


def test_leaves_are_halved_each_by_itself() -> None:
    scene, leaf = cloud(50), torch.arange(50) % 3
    found, leaves = halved(scene, leaf)
    assert torch.bincount(leaves).tolist() == [9, 9, 8]
    assert leaves.tolist() == sorted(leaves.tolist())
    for number in range(3):
        alone, _ = halved(scene[leaf == number], torch.zeros(int((leaf == number).sum()), dtype=torch.long))
        torch.testing.assert_close(found[leaves == number].means, alone.means)
    single, _ = halved(scene[:1], torch.zeros(1, dtype=torch.long))
    assert len(single) == 1


def test_half_of_a_surface_looks_like_it() -> None:
    """Better than half of its Gaussians left out at random, however these are enlarged."""
    scene = cloud(800)
    cameras = surround(scene.means, 2, 48, 64)

    def difference(other: Gaussians) -> float:
        return float((render(other, cameras).colour - render(scene, cameras).colour).square().mean())

    half, _ = halved(scene, torch.zeros(800, dtype=torch.long))
    assert len(half) == 400
    left = scene[:400]
    enlarged = min(difference(replace(left, scales=left.scales * factor)) for factor in (1.0, 1.2, 2**0.5, 1.7))
    assert difference(half) < enlarged / 2


def test_odd_gaussians_stay_finite() -> None:
    """Coincident ones, zero scales, a quaternion of zeros, and one far away."""
    odd = cloud(6)
    means, scales, quats = odd.means.clone(), odd.scales.clone(), odd.quats.clone()
    means[1], scales[2], quats[3], means[4] = means[0], 0, 0, 1e6
    scene = joined(replace(odd, means=means, scales=scales, quats=quats), odd)
    found, _ = halved(scene, torch.zeros(12, dtype=torch.long))
    assert len(found) == 6
    assert bool(found.finite.all())
    assert float(found.opacities.max()) <= 0.99
