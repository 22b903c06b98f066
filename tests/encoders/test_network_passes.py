"""A learned encoder runs its network once for each set of photos that the pipeline asks about."""

from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from synthetic import arc, photographs, room

from querysplat_cli.encoders.transformer.vgm import Vgm, VgmOutput
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.progress import Stages
from tiny_weights import write_weights


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> ReconstructSettings:
    folder = tmp_path_factory.mktemp("room")
    (folder / "photos").mkdir()
    for photo in photographs(room(), arc(5)):
        cv2.imwrite(str(folder / "photos" / photo.name), photo.pixels)
    weights = write_weights(folder / "weights")
    return ReconstructSettings(
        (folder / "photos",), folder / "scene.ply", preset="official-8192", weights=weights, max_size=112, force=True
    )


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize(("every", "passes"), [(None, [5]), (4, [5, 3])])
def test_the_network_runs_once_for_each_set_of_photos(
    settings: ReconstructSettings,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    every: int | None,
    passes: list[int],
    depth: bool,
) -> None:
    """Depth and features come from the pass that found the cameras. Held-out photos need a pass of their own."""
    counted: list[int] = []
    predict = Vgm.predict

    def counting(self: Vgm, images, **options) -> VgmOutput:  # type: ignore[no-untyped-def]
        counted.append(len(images))
        return predict(self, images, **options)

    monkeypatch.setattr(Vgm, "predict", counting)
    reconstruct(replace(settings, ply=tmp_path / "scene.ply", holdout_every=every, depth=depth), Stages())
    assert counted == passes
