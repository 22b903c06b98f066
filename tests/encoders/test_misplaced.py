"""Photos that wrong matches placed are found, and taken out or placed anew."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic import arc
from test_cameras_parts import project_distorted, scene

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical import mapping
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.mapping import Mapped, map_photos
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.several_lenses import _fits_better
from querysplat_cli.encoders.classical.sparse_model import SparseModel, mean_error, misplaced, photo_error
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.photos import find_photos, load_photos


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform([-1.5, -1, 4], [1.5, 1, 7], (300, 3))


def observed(count: int, cloud: np.ndarray, scatter: dict[int, float]) -> SparseModel:
    """A model of `count` photos whose observations scatter by 0.3 pixels, or as `scatter` says of a photo."""
    random, (model, _) = np.random.default_rng(1), scene(arc(count), cloud)
    pixels = {
        photo: project_distorted(cloud, camera) + random.normal(0, scatter.get(photo, 0.3), (len(cloud), 2))
        for photo, camera in model.cameras.items()
    }
    return replace(model, pixels=pixels)


def test_a_photo_that_fits_far_worse_than_the_others_is_misplaced(cloud: np.ndarray) -> None:
    assert misplaced(observed(6, cloud, {})) == []
    assert misplaced(observed(6, cloud, {2: 0.6})) == []
    assert misplaced(observed(6, cloud, {2: 1.2})) == [2]
    assert misplaced(observed(6, cloud, {2: 1.2, 4: 1.5})) == [2, 4]
    assert misplaced(observed(3, cloud, {2: 1.2})) == []


def test_errors_below_a_pixel_are_none_of_wrong_matches(cloud: np.ndarray) -> None:
    exact = dict.fromkeys(range(6), 0.05)
    assert misplaced(observed(6, cloud, {**exact, 2: 0.4})) == []


def test_nothing_holds_a_photo_without_observations(cloud: np.ndarray) -> None:
    """OpenCV projects no empty lists: five photos of fox ended in a traceback."""
    model = observed(5, cloud, {})
    model.seen[3], model.pixels[3] = np.empty(0, dtype=np.int64), np.empty((0, 2))
    assert len(model.errors(3)) == 0
    assert photo_error(model, 3) == CAMERA_POLICY.wrong_error
    assert np.isfinite(mean_error(model))
    assert misplaced(model) == [3]


def test_few_observations_do_not_tell_a_lens(cloud: np.ndarray) -> None:
    together = observed(5, cloud, {3: 3.0})
    alone = observed(5, cloud, {})
    camera = alone.cameras[3]
    alone.cameras[3] = replace(camera, focal=(1.3 * camera.focal[0], 1.3 * camera.focal[1]))
    alone.pixels[3] = project_distorted(cloud, alone.cameras[3])
    assert _fits_better(alone, together)
    few = CAMERA_POLICY.lens_apart_observations - 1
    alone.seen[3], alone.pixels[3] = alone.seen[3][:few], alone.pixels[3][:few]
    assert not _fits_better(alone, together)


def test_an_attempt_without_misplaced_photos_is_taken(cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    _, matches = scene(arc(6), cloud)
    models = {pycolmap.Reconstruction(): observed(6, cloud, scatter) for scatter in ({2: 1.5}, {}, {})}
    coming = iter(models)
    monkeypatch.setattr(mapping, "_mapped", lambda *given: [next(coming)])
    monkeypatch.setattr(mapping, "centred", lambda reconstruction, **lenses: reconstruction)
    monkeypatch.setattr(mapping, "from_colmap", models.__getitem__)
    found = map_photos(matches, (), seed=0)
    assert found is not None
    assert found.model is list(models.values())[1]


@pytest.mark.parametrize(("right", "assumes"), [(5, False), (4, False), (3, True)])
def test_no_lens_is_assumed_where_most_photos_tell_it(
    cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch, right: int, assumes: bool
) -> None:
    """Models with a fitted lens hold a part of the photos, and the last attempt, with the assumed one, holds all."""
    whole, matches = observed(8, cloud, {}), scene(arc(8), cloud)[1]
    part = replace(whole, cameras={photo: whole.cameras[photo] for photo in range(right)})
    part = replace(part, seen={photo: whole.seen[photo] for photo in range(right)})
    models = {pycolmap.Reconstruction(): each for each in (part, part, part, whole)}
    coming = iter(models)
    monkeypatch.setattr(mapping, "_mapped", lambda *given: [next(coming)])
    monkeypatch.setattr(mapping, "centred", lambda reconstruction, **lenses: reconstruction)
    monkeypatch.setattr(mapping, "_extended", lambda best, *given: best)
    monkeypatch.setattr(mapping, "from_colmap", models.__getitem__)
    found = map_photos(matches, (), seed=0)
    assert found is not None
    assert found.fit_lens is not assumes
    assert len(found.model.cameras) == (8 if assumes else right)


@pytest.mark.parametrize("numbers", [(5, 17, 19, 21, 34, 44), (2, 3, 14, 25, 37), (0, 5, 7, 19, 21, 26)])
def test_photos_of_repeating_wallpaper_stand_where_they_were_taken(real_photos: Path, numbers: tuple[int, ...]) -> None:
    """A photo was turned by 94°, and the others with it; or the lens was the assumed one, 1.7 times too long."""
    files = sorted((real_photos / "dl3dv/fox/images_4").iterdir())
    photos, _ = load_photos(find_photos([files[number] for number in numbers]))
    posed = estimate_cameras(photos, CameraRequest(224, seed=42), silent)
    true = read_known_cameras(real_photos / "dl3dv/fox/transforms.json")
    assert posed.views.names == tuple(photo.name for photo in photos)
    turns = [
        true[name].w2c[:3, :3].T @ found.w2c[:3, :3]
        for name, found in zip(posed.views.names, posed.photo_cameras, strict=True)
    ]
    cosines = [(np.trace(turn.T @ turns[0]) - 1) / 2 for turn in turns]
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 3


def test_a_misplaced_photo_is_left_out_or_placed_anew(cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    bad, good = pycolmap.Reconstruction(), pycolmap.Reconstruction()
    rest = pycolmap.Reconstruction()
    whole, wrong = observed(6, cloud, {}), observed(6, cloud, {2: 1.5})
    models = {bad: wrong, good: whole, rest: whole}
    _, matches = scene(arc(6), cloud)
    taken: list[list[int]] = []
    monkeypatch.setattr(mapping, "_without", lambda mapped, photos: taken.append(photos) or Mapped(whole, (), rest))
    monkeypatch.setattr(mapping, "centred", lambda reconstruction, **lenses: reconstruction)
    monkeypatch.setattr(mapping, "from_colmap", models.__getitem__)
    placed = {good: Mapped(whole, (), good), bad: Mapped(wrong, (), bad)}
    for grown, expected in ((placed[good], [[2], []]), (placed[bad], [[2], [2]])):
        taken.clear()
        monkeypatch.setattr(mapping, "_extended", lambda best, *given, grown=grown: grown)
        mapping.without_misplaced(Mapped(wrong, (), bad), matches, 0)
        assert taken == expected
    right = Mapped(whole, (), good)
    assert mapping.without_misplaced(right, matches, 0) is right
