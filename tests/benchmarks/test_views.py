"""What the program about more photos prints."""

import pytest

import views
from common.output import Table


def test_a_scene_that_failed_is_a_line_and_not_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    views.show(Table({"photos": ""}), {"views": 2, "error": "too few photos"})
    assert "2 photos: too few photos" in capsys.readouterr().err
