"""A street: houses on both sides, nothing on the walk, and the same for the same seed."""

import torch

from common.streets import make_street, stroll
from querysplat_cli.training.photographer import cast
from querysplat_cli.training.solids import distance_to


def test_the_walk_is_free_and_every_photo_shows_the_street() -> None:
    street, cameras = make_street(5, 10.0), stroll(10.0, 4, 5, 24, 32)
    assert make_street(5, 10.0) == street
    eyes = cameras.centres.double().numpy()
    assert min(distance_to(solid, eyes).min() for solid in street.solids) > 0.5
    images, depth = cast(street, cameras, samples=1)
    assert bool((depth > 0).all()), "a ray leaves the street"
    assert float(images.flatten(1).std(1).min()) > 0.02
    assert torch.allclose(cameras.centres[:, 0], torch.linspace(0, 10, 4), atol=1e-4)
