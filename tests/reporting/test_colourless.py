"""A warning where black-and-white photos lie among photos in colour, and none where all are alike."""

import torch

from querysplat_cli.reporting.colourless import colourless_warning
from querysplat_cli.scene.views import Views


def photos(*colourful: float) -> Views:
    """Photos of noise, whose colours count by the given shares; the right third is padding."""
    noise = torch.rand(len(colourful), 3, 12, 18, generator=torch.Generator().manual_seed(0))
    share = torch.tensor(colourful)[:, None, None, None]
    masks = torch.ones(len(colourful), 12, 18, dtype=torch.bool)
    masks[:, :, 12:] = False
    images = (share * noise + (1 - share) * noise.mean(1, keepdim=True)) * masks[:, None]
    return Views(images, masks, tuple(f"{i}.jpg" for i in range(len(colourful))), ((12, 12),) * len(colourful))


def test_photos_without_colour_among_others_are_named() -> None:
    (found,) = colourless_warning(photos(1, 0, 0.5, 0))
    assert "2 photos of 4 have no colour, such as 1.jpg" in found


def test_photos_that_are_alike_need_no_warning() -> None:
    assert colourless_warning(photos(1, 0.3, 0.8)) == ()
    assert colourless_warning(photos(0, 0)) == ()
    assert colourless_warning(photos(0, 0.02)) == ()  # grey ones, of which one was saved in colour
