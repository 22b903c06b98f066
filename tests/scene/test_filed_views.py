"""Views in a file are those that were put there, and take memory only while they are looked at."""

from pathlib import Path

import pytest
import torch

from querysplat_cli.scene.filed_views import FiledViews
from querysplat_cli.scene.views import Views

VIEWS, HEIGHT, WIDTH = 5, 12, 24


@pytest.fixture
def views() -> Views:
    """Of two sizes; the second has a hole."""
    chance = torch.Generator().manual_seed(2)
    masks = torch.ones(VIEWS, HEIGHT, WIDTH, dtype=torch.bool)
    masks[1, 3, 4] = False
    masks[2, :, 12:] = False
    sizes = tuple((HEIGHT, 12 if row == 2 else WIDTH) for row in range(VIEWS))
    return Views(torch.rand(VIEWS, 3, HEIGHT, WIDTH, generator=chance), masks, tuple("abcde"), sizes)


def test_they_are_the_same_views(views: Views, tmp_path: Path) -> None:
    filed = FiledViews(views, tmp_path / "all.views")
    assert len(filed) == VIEWS
    assert (filed.names, filed.sizes) == (views.names, views.sizes)
    assert torch.equal(filed.images, views.images)
    assert torch.equal(filed.masks, views.masks)
    assert torch.equal(filed.picture(3), views.images[3])


def test_some_of_them_are_in_memory(views: Views, tmp_path: Path) -> None:
    some = FiledViews(views, tmp_path / "all.views")[[4, 1]]
    (tmp_path / "all.views").unlink()
    assert type(some) is Views
    assert some.names == ("e", "b")
    assert torch.equal(some.images, views.images[[4, 1]])
    assert torch.equal(some.masks, views.masks[[4, 1]])


def test_pictures_of_bytes_get_the_range_of_the_others(views: Views, tmp_path: Path) -> None:
    whole = Views((views.images * 255).to(torch.uint8), views.masks, views.names, views.sizes)
    filed = FiledViews(whole, tmp_path / "all.views")
    assert torch.equal(filed.images, whole.images.float() / 255)


def test_nothing_that_is_changed_reaches_the_file(views: Views, tmp_path: Path) -> None:
    filed = FiledViews(views, tmp_path / "all.views")
    filed.images[0] = 0.0
    assert torch.equal(filed.images, views.images)
