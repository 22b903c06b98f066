"""The photos that the package has for its demo."""

from pathlib import Path

import numpy as np

from querysplat_cli.commands.demo import copy_shipped_photos
from querysplat_cli.commands.requests import DemoRequest
from querysplat_cli.scene.photos import WHOLE, load_photo
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room


def test_shipped_photos_are_those_of_the_ray_caster(tmp_path: Path) -> None:
    """But for what JPEG loses: 2.2 grey levels."""
    copy_shipped_photos(tmp_path)
    scene = make_room(DemoRequest.seed)
    cameras = walk(scene, DemoRequest.photos, DemoRequest.seed)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [f"photo_{number + 1:02d}.jpg" for number in range(DemoRequest.photos)]
    for number in (0, DemoRequest.photos - 1):
        photo = load_photo(tmp_path / names[number], names[number], WHOLE)
        assert isinstance(photo, Photo)
        taken = 255 * cast(scene, cameras[[number]])[0][0].permute(1, 2, 0).clamp(0, 1).numpy()
        assert np.abs(photo.pixels - taken).mean() < 3
