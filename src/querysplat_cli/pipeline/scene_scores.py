"""How well a finished scene shows its photos, and the ones that were held out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from querysplat_cli.encoders.holdout import PosedSplit
from querysplat_cli.pipeline.build import BuiltScene
from querysplat_cli.pipeline.full_size import LargePhotos, full_size_quality
from querysplat_cli.reporting.unseen import Unseen, unseen
from querysplat_cli.reporting.view_scores import Quality, score
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.photo_files import photo_files
from querysplat_cli.scene.views import PhotoSource


@dataclass(frozen=True)
class SceneScores:
    """Of the inputs, of held-out views and at the size of large photos (None without any), and what no photo saw."""

    inputs: Quality
    heldout: Quality | None
    large: dict[str, Any] | None
    unseen: Unseen | None


def score_scene(
    scene: BuiltScene, split: PosedSplit, sources: Mapping[str, PhotoSource], stages: Stages
) -> SceneScores:
    """The scores of a scene; `sources` says by name where its photos come from."""
    with stages("score"):
        quality = score(scene.gaussians, scene.posed.views, scene.adapted.cameras)
        heldout = scene.heldout(split)
        scored = score(scene.gaussians, *heldout) if heldout else None
        film = unseen(scene.gaussians, scene.adapted.cameras, scene.posed.views.sizes)
    return SceneScores(quality, scored, _score_large(scene, split, sources, stages), film)


def heldout_photos(scene: BuiltScene, split: PosedSplit, sources: Mapping[str, PhotoSource]) -> LargePhotos | None:
    """The held-out photos with their cameras; None without any."""
    heldout = scene.heldout(split)
    if heldout is None:
        return None
    return LargePhotos(*heldout, photo_files(heldout[0].names, split.heldout_photo_cameras, sources))


def _score_large(
    scene: BuiltScene, split: PosedSplit, sources: Mapping[str, PhotoSource], stages: Stages
) -> dict[str, Any] | None:
    """Scores at the size of the large photos, where the scene was optimised on photos larger than the working ones."""
    if scene.full_size is None or scene.full_size.size <= scene.inputs.working:
        return None
    with stages("full size score"):
        heldout = heldout_photos(scene, split, sources)
        return full_size_quality(scene.gaussians, scene.full_size.size, scene.inputs, heldout)
