"""Which scenes are optimised with LPIPS, and what is said of those that are not."""

from pathlib import Path

import pytest

from lpips_weights import write_weights
from querysplat_cli.pipeline.perceptual import optimisation_lpips
from querysplat_cli.reporting import omissions
from querysplat_cli.runtime.errors import MissingPart


@pytest.fixture(autouse=True)
def no_weights_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    optimisation_lpips.cache_clear()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))


def test_a_folder_is_used_by_every_model_and_the_cache_by_official_ones(tmp_path: Path) -> None:
    write_weights(tmp_path / "given", "vgg")
    plain, official = (optimisation_lpips(tmp_path / "given", official=official) for official in (False, True))
    assert plain is not None
    assert official is not None
    assert (plain.as_release, official.as_release) == (False, True)
    assert optimisation_lpips(None, official=True) is None
    (tmp_path / "home" / "hub").mkdir(parents=True)
    (tmp_path / "given").rename(tmp_path / "home" / "hub" / "checkpoints")
    optimisation_lpips.cache_clear()
    assert optimisation_lpips(None, official=True) is not None
    assert optimisation_lpips(None, official=False) is None


def test_a_folder_without_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingPart, match="LPIPS needs the backbone"):
        optimisation_lpips(tmp_path, official=False)


@pytest.mark.parametrize(
    ("stepped", "used", "further", "why"),
    [
        (True, False, False, "its weights are not part"),
        (True, True, False, ""),
        (True, True, True, "small pictures only"),
        (False, False, False, ""),
        (False, False, True, "its weights are not part"),
    ],
)
def test_lpips_is_reported_as_left_out_only_where_it_was(stepped: bool, used: bool, further: bool, why: str) -> None:
    found = omissions.without_lpips(stepped=stepped, used=used, further=further)
    assert [line.what for line in found] == (["LPIPS loss"] if why else [])
    assert all(why in line.why for line in found)
