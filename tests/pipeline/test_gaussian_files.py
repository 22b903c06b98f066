"""Kinds of files of Gaussians, which are listed in more than one place: a list's box may not import the other's."""

from querysplat_cli.pipeline.gaussian_files import READERS, WRITERS
from querysplat_cli.scene.formats.known import GAUSSIAN_KINDS


def test_every_kind_that_is_read_is_known_to_have_no_cameras() -> None:
    assert tuple(READERS) == tuple(WRITERS) == GAUSSIAN_KINDS
