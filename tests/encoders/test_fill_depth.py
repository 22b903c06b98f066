"""Filled depth continues the planes of confirmed depth, and does not cross the edges in the photo."""

import numpy as np

from querysplat_cli.encoders.classical.fill_depth import fill_depth

HEIGHT, WIDTH = 48, 400


def test_a_far_guess_follows_what_was_confirmed() -> None:
    inverse = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    confidence = np.zeros_like(inverse)
    inverse[:, :20], confidence[:, :20] = 1, 1
    filled = fill_depth(inverse, confidence, np.full((HEIGHT, WIDTH, 3), 0.5), np.ones(inverse.shape, bool))
    np.testing.assert_array_equal(filled[:, :20], 1)
    assert filled.max() < 1.2


def test_each_side_of_an_edge_follows_its_own() -> None:
    inverse = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    confidence = np.zeros_like(inverse)
    image = np.full((HEIGHT, WIDTH, 3), 0.2)
    image[:, WIDTH // 2 :] = 0.8
    for columns, near in ((slice(0, 20), 1.0), (slice(-20, None), 2.0)):
        inverse[:, columns], confidence[:, columns] = near, 1
    filled = fill_depth(inverse, confidence, image, np.ones(inverse.shape, bool))
    np.testing.assert_allclose(filled[:, : WIDTH // 2], 1, atol=0.1)
    np.testing.assert_allclose(filled[:, WIDTH // 2 :], 2, atol=0.1)


def test_a_table_goes_on_as_a_plane_beyond_what_was_measured() -> None:
    inverse = np.broadcast_to(np.linspace(1.4, 1, WIDTH, dtype=np.float32), (HEIGHT, WIDTH)).copy()
    table, confidence = inverse.copy(), np.ones_like(inverse)
    inverse[:, -60:], confidence[:, -60:] = 3, 0
    filled = fill_depth(inverse, confidence, np.full((HEIGHT, WIDTH, 3), 0.5), np.ones(inverse.shape, bool))
    np.testing.assert_allclose(filled, table, atol=0.02)  # 0.06 without slopes


def test_without_anything_confirmed_guesses_stay() -> None:
    inverse = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    filled = fill_depth(inverse, np.zeros_like(inverse), np.full((HEIGHT, WIDTH, 3), 0.5), np.ones(inverse.shape, bool))
    np.testing.assert_allclose(filled, 3, rtol=1e-4)
