"""Rotations against SciPy's, in every direction and at every angle."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from querysplat_cli.scene.rotations import (
    matrix_to_quaternion,
    quaternion_product,
    quaternion_to_matrix,
    rotate_vectors,
    rotation_angles,
    skew,
)


def scalar_first(rotations: Rotation) -> torch.Tensor:
    return torch.from_numpy(rotations.as_quat()[:, [3, 0, 1, 2]])


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: sum(x * x for x in q) > 0.01))
def test_quaternions_of_matrices_are_those_of_scipy(parts: list[float]) -> None:
    rotation = Rotation.from_quat(parts)
    found = matrix_to_quaternion(torch.from_numpy(rotation.as_matrix()))
    again = Rotation.from_quat(found.roll(-1, -1).numpy())
    assert (again.inv() * rotation).magnitude() < 1e-7


@pytest.mark.parametrize("length", [1e-20, 1.0, 1e20])
def test_matrices_of_quaternions_of_any_length_are_those_of_scipy(length: float) -> None:
    rotations = Rotation.random(20, random_state=0)
    found = quaternion_to_matrix(length * scalar_first(rotations))
    torch.testing.assert_close(found, torch.from_numpy(rotations.as_matrix()))


def test_quaternion_product_multiplies_rotations() -> None:
    a, b = Rotation.random(10, random_state=0), Rotation.random(10, random_state=1)
    ours = quaternion_product(*(torch.from_numpy(r.as_quat()[:, [3, 0, 1, 2]]) for r in (a, b)))
    theirs = torch.from_numpy((a * b).as_quat()[:, [3, 0, 1, 2]])
    torch.testing.assert_close(ours * ours[:, :1].sign(), theirs * theirs[:, :1].sign())


def test_a_quaternion_turns_a_vector_as_its_matrix_does() -> None:
    quats = scalar_first(Rotation.random(20, random_state=2))
    vectors = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = (quaternion_to_matrix(quats) @ vectors[..., None])[..., 0]
    torch.testing.assert_close(rotate_vectors(quats, vectors), expected)


def test_the_exponential_of_a_skew_matrix_turns_about_its_vector() -> None:
    vectors = torch.tensor([[0.3, -1.2, 0.5], [0.0, 0.0, 2.0]], dtype=torch.float64)
    expected = torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    torch.testing.assert_close(torch.linalg.matrix_exp(skew(vectors)), expected)


@pytest.mark.parametrize("degrees", [0, 1e-6, 1e-3, 1, 90, 179.999, 180])
def test_angles_near_their_ends(degrees: float) -> None:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0, 0.8])).as_matrix()
    assert float(rotation_angles(torch.from_numpy(turn))) == pytest.approx(degrees, abs=1e-9)
    assert rotation_angles(torch.from_numpy(turn).expand(2, 1, 3, 3)).shape == (2, 1)
