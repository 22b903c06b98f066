"""Captures of procedural scenes, photos and videos: reproducible, with separate inputs and targets."""

import shutil
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.formats.dataset import CapturedScene, find_scenes
from querysplat_cli.training.captures import drawn_views
from querysplat_cli.training.config import DataSettings, SourceSettings, StageSettings
from querysplat_cli.training.data import PreparedSamples
from querysplat_cli.training.outdoors import make_outdoors
from querysplat_cli.training.photographer import wander
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.procedural import varied_scene
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.run import TrainRequest, train
from querysplat_cli.training.solids import Solid, distance_to
from querysplat_cli.training.sources import notes_of, open_source
from querysplat_cli.training.tabletops import TOP, make_tabletop
from training_scenes import sample, training

WHITE = (1.0, 1.0, 1.0)


@given(
    frames=st.integers(1, 60),
    fewest=st.integers(2, 6),
    more=st.integers(0, 6),
    targets=st.integers(1, 6),
    interval=st.tuples(st.integers(1, 5), st.integers(0, 9)),
    seed=st.integers(0, 2**31),
)
def test_inputs_and_targets_are_apart_and_on_the_reel(
    frames: int, fewest: int, more: int, targets: int, interval: tuple[int, int], seed: int
) -> None:
    low, extra = interval
    settings = SourceSettings("captured", inputs=(fewest, fewest + more), targets=targets, interval=(low, low + extra))
    chance = np.random.default_rng(seed)
    if frames <= fewest:
        with pytest.raises(QuerySplatError):
            drawn_views(chance, settings, frames)
        return
    inputs, others = drawn_views(chance, settings, frames)
    assert fewest <= len(inputs) <= fewest + more
    steps = np.diff(inputs)
    assert (steps == steps[0]).all()
    assert 1 <= steps[0] <= low + extra
    assert 1 <= len(others) <= targets
    assert not set(inputs) & set(others)
    assert all(0 <= frame < frames for frame in (*inputs, *others))
    assert list(others) == sorted(set(others))


def test_a_procedural_capture_depends_on_seed_scene_and_draw_alone() -> None:
    settings = SourceSettings("procedural", size=(48, 64), inputs=(2, 3), targets=1, cameras="posed")
    source = open_source(settings)
    first, again, other = source.capture(3, 0), open_source(settings).capture(3, 0), source.capture(3, 1)
    assert [photo.name for photo in first.photos] == [photo.name for photo in again.photos]
    assert all(np.array_equal(a.pixels, b.pixels) for a, b in zip(first.photos, again.photos, strict=True))
    assert first.photos[0].pixels.tobytes() != other.photos[0].pixels.tobytes()
    assert first.known is not None
    assert set(first.inputs) < set(first.known)
    assert {photo.name for photo in first.photos} == set(first.known)
    photo, camera = first.photos[0], first.known[first.photos[0].name]
    assert (photo.height, photo.width) == (camera.height, camera.width)
    assert photo.pixels.dtype == np.uint8
    assert len(source) == settings.scenes


@pytest.mark.parametrize("seed", range(6))
def test_no_photographer_stands_in_a_solid(seed: int) -> None:
    made = make_outdoors(seed) if seed % 2 else make_room(seed)
    try:
        cameras = wander(made, 9, seed, 60, 80)
    except ValueError:
        pytest.skip("this scene has no room")
    eyes = cameras.to(torch.float64).centres.numpy()
    assert min(distance_to(solid, eyes).min() for solid in made.solids) > TRAINING_POLICY.clearance
    rotation = cameras.w2c[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(9, 3, 3), rtol=0, atol=1e-5)
    assert (rotation[:, 1, 2] < 0.2).all(), "the world's up is the picture's up"


def test_varied_scenes_have_dark_glossy_and_thin_things() -> None:
    """Some have none of a kind; all of a seed are the same."""
    scenes = [varied_scene(seed) for seed in range(24)]
    assert scenes[5] == varied_scene(5)
    dark = [sum(max(solid.first) < 0.2 for solid in made.solids) / len(made.solids) for made in scenes]
    glossy = [sum(solid.gloss > 0 for solid in made.solids) / len(made.solids) for made in scenes]
    for shares in (dark, glossy):
        assert min(shares) < 0.1
        assert 0.15 < max(shares) < 0.8
    thin = [sum(min(solid.size) < 0.013 for solid in made.solids) for made in scenes]
    assert max(thin) > 10
    assert all(solid.gloss == 0 for solid in make_room(0).solids)


def test_things_stand_on_the_table() -> None:
    made = make_tabletop(4)
    small = [solid for solid in made.solids if max(solid.size) < 0.2 and solid.centre[2] > TOP]
    assert len(small) >= 8
    assert all(abs(solid.centre[0]) < 0.5 and abs(solid.centre[1]) < 0.5 for solid in small)
    assert min(solid.centre[2] - solid.size[2] for solid in small) == pytest.approx(TOP)
    assert made.reach < make_room(4).reach


def test_colours_change_from_photo_to_photo_of_varied_captures() -> None:
    """Exposure changes all channels, white balance each one."""
    settings = SourceSettings("procedural", size=(32, 40), inputs=(3, 3), targets=1, cameras="posed", varied=True)
    source, plain = open_source(settings), open_source(SourceSettings("procedural", size=(32, 40), inputs=(3, 3)))
    captures = [source.capture(scene, 0) for scene in range(4)]
    again = open_source(settings).capture(2, 0)
    assert captures[2].photos[0].pixels.tobytes() == again.photos[0].pixels.tobytes()
    assert plain.capture(2, 0).photos[0].pixels.tobytes() != again.photos[0].pixels.tobytes()
    assert len({capture.photos[0].pixels.tobytes() for capture in captures}) == 4


@pytest.mark.parametrize("shape", [BOX, BALL, CYLINDER])
def test_distances_are_zero_on_surfaces_and_negative_inside(shape: int) -> None:
    solid = Solid(shape, (1, 2, 3), (0.5, 0.5, 0.5), "plain", WHITE, WHITE, turn=0.4)
    points = np.array([[1.0, 2, 3.5], [1, 2, 3], [1, 2, 4.5]])
    np.testing.assert_allclose(distance_to(solid, points), [0, -0.5, 1], atol=1e-12)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "place"
    folder.mkdir()
    for i in range(6):
        pixels = np.random.default_rng(i).integers(0, 255, (70, 90, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), pixels)
    return folder


@pytest.mark.parametrize("kind", ["folder", "zip"])
def test_photos_of_folders_and_zips(pictures: Path, kind: str) -> None:
    place = pictures
    if kind == "zip":
        place = pictures.with_suffix(".zip")
        with zipfile.ZipFile(place, "w") as archive:
            for file in pictures.iterdir():
                archive.write(file, f"place/{file.name}")
    source = open_source(SourceSettings("captured", (str(place),), inputs=(2, 2), targets=2, interval=(1, 2)))
    assert len(source) == 1
    capture = source.capture(0, 0)
    assert capture.known is None
    assert set(capture.inputs) < {photo.name for photo in capture.photos}
    posed = SourceSettings("captured", (str(place),), inputs=(2, 2), targets=2, cameras="posed")
    with pytest.raises(QuerySplatError, match="no cameras"):
        open_source(posed).capture(0, 0)


@pytest.mark.parametrize("kind", ["alpha", "file"])
def test_masks_of_captured_photos_are_kept(pictures: Path, kind: str) -> None:
    """They were dropped, so that training took what is masked for a part of the scene."""
    shown = np.zeros((70, 90), np.uint8)
    shown[:, 30:] = 255
    for file in sorted(pictures.iterdir()):
        if kind == "alpha":
            cv2.imwrite(str(file), np.dstack([cv2.imread(str(file)), shown]))
        else:
            (pictures.parent / "masks").mkdir(exist_ok=True)
            cv2.imwrite(str(pictures.parent / "masks" / file.name), shown)
    source = open_source(SourceSettings("captured", (str(pictures),), inputs=(2, 2), targets=2, interval=(1, 2)))
    for photo in source.capture(0, 0).photos:
        assert photo.mask is not None
        np.testing.assert_array_equal(photo.mask, shown > 0)


def test_notes_name_what_is_unusual_about_scenes_once(pictures: Path) -> None:
    """Training left a damaged scene out without a word."""
    shutil.copytree(pictures, pictures.parent / "all" / "good")
    (pictures.parent / "all" / "torn.zip").write_bytes(b"PK")
    settings = SourceSettings("captured", (str(pictures.parent / "all"),))
    (note,) = notes_of([settings, replace(settings, inputs=(2, 2)), SourceSettings("procedural")])
    assert "torn: left out" in note
    with pytest.raises(QuerySplatError, match="no zip"):
        open_source(settings).capture(1, 0)


def test_one_walk_serves_all_stages_of_a_training(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders were walked for the notes, and three times for each stage."""
    walks = []

    def counted(places: Sequence[Path], preferred: str) -> list[CapturedScene]:
        walks.append(places)
        return find_scenes(places, preferred)

    monkeypatch.setattr("querysplat_cli.training.sources.find_scenes", counted)
    monkeypatch.setattr("querysplat_cli.training.data.make_sample", lambda *_, **__: sample(0))
    source = SourceSettings("captured", (str(pictures),), inputs=(2, 3), targets=1, interval=(1, 1))
    config = replace(
        training(tmp_path / "cache", scenes=1),
        data=DataSettings((source,), cache=str(tmp_path / "cache"), encoder="classical"),
        stages=tuple(StageSettings(steps=1, lr=1e-3, inputs=(count, count)) for count in (2, 3)),
    )
    for turn in (1, 2):  # a later training sees what was added
        made = train(TrainRequest(config, tmp_path / "out", device="cpu", workers=1, samples_only=True), Stages())
        assert made == PreparedSamples(2, ())
        assert len(walks) == turn


def test_frames_of_a_film(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    with av.open(str(path), "w") as film:
        stream = film.add_stream("h264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(12):
            pixels = np.full((64, 96, 3), 20 * i, np.uint8)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        film.mux(stream.encode())
    source = open_source(SourceSettings("captured", (str(path),), inputs=(3, 3), targets=2, interval=(1, 2)))
    capture = source.capture(0, 0)
    numbers = [int(photo.name[:6]) for photo in capture.photos]
    assert numbers == sorted(numbers)
    for number, photo in zip(numbers, capture.photos, strict=True):
        assert abs(float(photo.pixels.mean()) - 20 * number) < 6
    other = tmp_path / "other.mp4"
    other.write_bytes(b"no film")
    with pytest.raises(QuerySplatError, match="not a film"):
        open_source(SourceSettings("captured", (str(other),))).capture(0, 0)


def test_missing_places_are_refused(tmp_path: Path) -> None:
    for place in ("nowhere", "nowhere.mp4"):
        with pytest.raises(QuerySplatError):
            open_source(SourceSettings("captured", (str(tmp_path / place),)))
