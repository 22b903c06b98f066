"""Colour corrections against closed forms, and on pictures that have no slope."""

import numpy as np
import pytest
import torch

from querysplat_cli.splat.colour_correction import channel_corrected, matrix_corrected

EVERYWHERE = torch.ones(24, 31, dtype=torch.bool)


def pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A render and a photo: other exposures, mixed channels, and noise."""
    generator = torch.Generator().manual_seed(seed)
    photo = torch.rand(3, 24, 31, generator=generator)
    mixing = torch.tensor([[0.6, 0.1, 0.0], [0.1, 0.5, 0.1], [0.0, 0.2, 0.7]])
    render = torch.einsum("ij,jhw->ihw", mixing, photo) + 0.05 * torch.rand(3, 24, 31, generator=generator)
    return render.clamp(0, 1), photo


def closed_form(render: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """One channel: slope and offset from the photo to the render by NumPy's covariance, and their inverse."""
    covariance = np.cov(photo.ravel(), render.ravel(), bias=True)
    slope = covariance[0, 1] / covariance[0, 0]
    return np.clip((render - render.mean()) / slope + photo.mean(), 0, 1)


def test_each_channel_has_the_closed_form() -> None:
    render, photo = pair()
    found = channel_corrected(render, photo, EVERYWHERE)
    assert found.dtype == render.dtype
    for channel in range(3):
        expected = closed_form(render[channel].double().numpy(), photo[channel].double().numpy())
        np.testing.assert_allclose(found[channel].double().numpy(), expected, atol=1e-6)


def test_masked_pixels_have_no_part_in_the_fit() -> None:
    render, photo = pair()
    mask = EVERYWHERE.clone()
    mask[:, 20:] = False
    spoiled = photo.clone()
    spoiled[:, :, 20:] = 0.9
    found = channel_corrected(render, spoiled, mask)
    torch.testing.assert_close(found, channel_corrected(render, photo, mask))
    torch.testing.assert_close(found[..., :20], channel_corrected(render[..., :20], photo[..., :20], mask[:, :20]))


def test_an_exposure_is_undone_and_mixed_channels_are_not() -> None:
    """A 3 × 4 transform undoes both."""
    _, photo = pair()
    gains = torch.tensor([0.5, 0.8, 0.6])[:, None, None]
    torch.testing.assert_close(channel_corrected(gains * photo + 0.1, photo, EVERYWHERE), photo)
    mixed = torch.stack([0.5 * photo[0] + 0.5 * photo[1], photo[1], photo[2]])
    assert (channel_corrected(mixed, photo, EVERYWHERE) - photo).abs().max() > 0.2
    assert (matrix_corrected(mixed, photo, EVERYWHERE) - photo).abs().max() < 1e-3


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_a_channel_of_one_value_is_shifted_to_the_photos_mean(value: float) -> None:
    render, photo = pair()
    flat = torch.full_like(photo, value)
    found = channel_corrected(flat, photo, EVERYWHERE)
    torch.testing.assert_close(found, photo.mean((1, 2), keepdim=True).expand_as(photo), atol=1e-6, rtol=0)
    towards = channel_corrected(render, flat, EVERYWHERE)
    torch.testing.assert_close(towards, (render - render.mean((1, 2), keepdim=True) + value).clamp(0, 1))
    torch.testing.assert_close(channel_corrected(flat, flat, EVERYWHERE), flat)


def test_without_any_pixel_to_fit_nothing_changes() -> None:
    render, photo = pair()
    torch.testing.assert_close(channel_corrected(render, photo, torch.zeros_like(EVERYWHERE)), render)
