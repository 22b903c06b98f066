"""Similarities against their own definition, and refusals where they are not determined."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.sim3 import DegenerateAlignment, Sim3, align_cameras


def similarity(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    rotation = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Sim3(float(np.exp(rng.uniform(-7, 7))), rotation, torch.from_numpy(rng.normal(size=3) * 10))


def cameras(seed: int, count: int) -> Cameras:
    rng = np.random.default_rng(seed)
    w2c = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    w2c[:, :3, :3] = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix()).reshape(count, 3, 3)
    w2c[:, :3, 3] = torch.from_numpy(rng.normal(size=(count, 3)))
    return Cameras(w2c, torch.eye(3, dtype=torch.float64).repeat(count, 1, 1), 10, 10)


@given(seed=st.integers(0, 10_000), count=st.integers(2, 8))
def test_cameras_give_back_the_similarity_even_two_of_them(seed: int, count: int) -> None:
    truth, before = similarity(seed), cameras(seed, count)
    after = before.transformed(truth)
    found = align_cameras(before.w2c, after.w2c)
    torch.testing.assert_close(found.scale, truth.scale, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.rotation, truth.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.centres, truth.apply(before.centres), rtol=1e-6, atol=1e-6 * truth.scale)


@given(seed=st.integers(0, 10_000))
def test_pictures_do_not_change_when_world_and_cameras_move_together(seed: int) -> None:
    truth, before = similarity(seed), cameras(seed, 3)
    points = torch.from_numpy(np.random.default_rng(seed + 2).normal(size=(20, 3)))
    seen = points @ before.w2c[0, :3, :3].T + before.w2c[0, :3, 3]
    moved = before.transformed(truth)
    seen_after = truth.apply(points) @ moved.w2c[0, :3, :3].T + moved.w2c[0, :3, 3]
    torch.testing.assert_close(seen_after / truth.scale, seen, rtol=1e-6, atol=1e-6)


def test_cameras_at_one_place_are_refused() -> None:
    here = cameras(3, 4)
    w2c = here.w2c.clone()
    w2c[:, :3, 3] = 0
    with pytest.raises(DegenerateAlignment, match="one place"):
        align_cameras(w2c, w2c)


def disturbed(w2c: torch.Tensor, which: int, *, rotation: bool, centre: bool) -> torch.Tensor:
    """Camera `which` elsewhere, or looking elsewhere."""
    wrong = Cameras(w2c[[which]], torch.eye(3, dtype=torch.float64)[None], 10, 10).c2w[0]
    if rotation:
        wrong[:3, :3] = wrong[:3, :3] @ torch.from_numpy(Rotation.from_rotvec([0, 2.0, 0.3]).as_matrix())
    if centre:
        wrong[:3, 3] += 5 * (1 + wrong[:3, 3].norm()) * torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    changed = w2c.clone()
    changed[which] = torch.linalg.inv(wrong)
    return changed


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(4, 9),
    kind=st.sampled_from([(True, True), (True, False), (False, True)]),
)
def test_one_wrong_camera_does_not_move_the_others(seed: int, count: int, kind: tuple[bool, bool]) -> None:
    truth, before = similarity(seed), cameras(seed, count)
    noisy = before.transformed(truth)
    twist = Rotation.from_rotvec(1e-3 * np.random.default_rng(seed).normal(size=(count, 3))).as_matrix()
    w2c = noisy.w2c.clone()
    w2c[:, :3] = torch.from_numpy(twist) @ w2c[:, :3]
    wrong = disturbed(w2c, seed % count, rotation=kind[0], centre=kind[1])
    found = align_cameras(before.w2c, wrong)
    assert found.scale == pytest.approx(truth.scale, rel=0.05)
    torch.testing.assert_close(found.rotation, truth.rotation, rtol=0, atol=0.02)


def test_no_camera_is_left_out_for_a_little_noise() -> None:
    before = cameras(1, 6)
    w2c = before.w2c.clone()
    w2c[:, :3, 3] += 0.01 * torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))
    everybody = align_cameras(before.w2c[[5, 0, 1, 2, 3, 4]], w2c[[5, 0, 1, 2, 3, 4]])
    alone = [align_cameras(before.w2c[rows], w2c[rows]) for rows in ([0, 1, 2, 3, 4], [1, 2, 3, 4, 5])]
    assert all(abs(everybody.scale - each.scale) > 1e-9 for each in alone)


def test_cameras_without_a_positive_scale_are_refused() -> None:
    before = cameras(5, 2)
    after = before.w2c.clone()
    after[:, :3, 3] = after[[1, 0], :3, 3]
    after[:, :3, :3] = torch.eye(3, dtype=torch.float64)
    same = before.w2c.clone()
    same[:, :3, :3] = torch.eye(3, dtype=torch.float64)
    with pytest.raises(DegenerateAlignment, match="no positive scale"):
        align_cameras(same, after)
