"""Samples: two passes joined by a similarity, their files, and the draw of each step's samples."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import CameraRequest, Geometry, PosedViews
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.workers import Workers
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo, Views
from querysplat_cli.training.captures import Capture
from querysplat_cli.training.config import DataSettings, SourceSettings, StageSettings, load_config
from querysplat_cli.training.data import (
    CachedSamples,
    Draw,
    RecentResults,
    Samples,
    cache_folder,
    prepare_samples,
    sources_of_stages,
)
from querysplat_cli.training.online import OnlineSamples
from querysplat_cli.training.passes import make_sample, read_sample, write_sample
from training_scenes import sample, training


class Surveyor:
    """An encoder with true cameras whose frame differs from pass to pass: the first camera is the origin,
    and its unit grows with the number of photos."""

    name, size, own_frame = "surveyor", 64, True

    def __init__(self, loses: str = "") -> None:
        self._loses = loses
        self.passes: list[tuple[str, ...]] = []

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        photos = [photo for photo in photos if photo.name != self._loses]
        self.passes.append(tuple(photo.name for photo in photos))
        true = places()
        chosen = true[[int(photo.name[0]) for photo in photos]]
        own = Sim3(float(len(photos)), chosen.w2c[0, :3, :3].double(), 3 * chosen.w2c[0, :3, 3].double())
        images = torch.stack([torch.from_numpy(photo.pixels).permute(2, 0, 1).float() / 255 for photo in photos])
        names, sizes = tuple(photo.name for photo in photos), ((12, 18),) * len(photos)
        views = Views(images, torch.ones(len(photos), 12, 18, dtype=torch.bool), names, sizes)
        nothing = tuple(torch.zeros(0, dtype=torch.long) for _ in photos)
        return PosedViews(views, chosen.transformed(own), torch.zeros(0, 3), nothing)

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        size = len(posed.views), 12, 18
        return Geometry(torch.ones(size), torch.ones(size), (posed.views.images.flatten(2).mT[:, :6, :],), 6)

    def free(self) -> None:
        pass

    def bytes_needed(self, views: int, size: int) -> int | None:
        return None


def places() -> Cameras:
    w2c = torch.eye(4).repeat(5, 1, 1)
    for i in range(5):
        angle = torch.tensor(0.2 * i)
        w2c[i, 0, 0], w2c[i, 0, 2], w2c[i, 2, 0], w2c[i, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
        w2c[i, :3, 3] = torch.tensor([0.3 * i, 0.1 * i * i, 2.0])
    K = torch.tensor([[20.0, 0, 9], [0, 20, 6], [0, 0, 1]]).repeat(5, 1, 1)
    return Cameras(w2c, K, 12, 18)


def photos(seed: int = 0) -> list[Photo]:
    chance = np.random.default_rng(seed)
    return [
        Photo(f"{i}.png", Path(f"{i}.png"), chance.integers(0, 255, (12, 18, 3)).astype(np.uint8)) for i in range(5)
    ]


INPUTS = ("0.png", "2.png", "3.png")


def prepared(encoder: Surveyor, given: list[Photo]):  # type: ignore[no-untyped-def]
    return make_sample(Capture(tuple(given), INPUTS, None), encoder, max_size=64, seed=0)


def test_targets_come_to_the_frame_of_the_inputs() -> None:
    encoder = Surveyor()
    found = prepared(encoder, photos())
    assert encoder.passes == [tuple(f"{i}.png" for i in range(5)), INPUTS]
    assert (found.views.names, found.targets.names) == (INPUTS, ("1.png", "4.png"))
    true = places()
    own = Sim3(3.0, true.w2c[0, :3, :3].double(), 3 * true.w2c[0, :3, 3].double())
    torch.testing.assert_close(found.target_cameras.w2c, true[[1, 4]].transformed(own).w2c, rtol=1e-4, atol=1e-4)


def test_target_pixels_change_nothing_but_the_targets() -> None:
    given = photos()
    one = prepared(Surveyor(), given)
    two = prepared(
        Surveyor(), [photo if photo.name in INPUTS else other for photo, other in zip(given, photos(1), strict=True)]
    )
    assert not torch.equal(one.targets.images, two.targets.images)
    assert torch.equal(one.views.images, two.views.images)
    assert torch.equal(one.cameras.w2c, two.cameras.w2c)
    assert torch.equal(one.geometry.features[0], two.geometry.features[0])


@pytest.mark.parametrize("lost", ["2.png"])
def test_a_lost_input_makes_the_sample_impossible(lost: str) -> None:
    with pytest.raises(ImpossibleScene):
        prepared(Surveyor(lost), photos())


def test_a_sample_comes_back_from_its_file(tmp_path: Path) -> None:
    before = sample(0)
    write_sample(tmp_path / "a.safetensors", before)
    after = read_sample(tmp_path / "a.safetensors")
    assert after.views.names == before.views.names
    assert after.targets.sizes == before.targets.sizes
    torch.testing.assert_close(after.views.images, before.views.images, rtol=0, atol=0.5 / 255 + 1e-6)
    torch.testing.assert_close(after.geometry.depth, before.geometry.depth, rtol=5e-4, atol=0)
    assert torch.equal(after.geometry.features[0], before.geometry.features[0])
    assert torch.equal(after.target_cameras.K, before.target_cameras.K)
    (tmp_path / "a.safetensors").write_bytes((tmp_path / "a.safetensors").read_bytes()[:-100])
    with pytest.raises(QuerySplatError, match="damaged"):
        read_sample(tmp_path / "a.safetensors")


def test_what_is_prepared_once_is_not_prepared_again(tmp_path: Path) -> None:
    source = SourceSettings("procedural", scenes=3, size=(60, 66), inputs=(2, 2), targets=1, cameras="posed")
    data = DataSettings((source,), cache=str(tmp_path), encoder="surveyor", max_size=66)
    asked = 0

    class Failing(Surveyor):
        def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
            raise ImpossibleScene("nothing overlaps")

    def encoder() -> Surveyor:
        nonlocal asked
        asked += 1
        return Failing()

    for rank in (0, 1):
        prepare_samples(data, encoder, rank=rank, world=2, progress=lambda text, fraction: None)
    assert asked == 2
    again = prepare_samples(data, encoder, progress=lambda text, fraction: None)
    assert asked == 2
    assert again.ready == 0
    assert len(again.failed) == 3
    assert "nothing overlaps" in again.failed[0]
    with pytest.raises(QuerySplatError, match="no samples"):
        CachedSamples(data, 0).path(Draw(0, 0, (2, 2)))
    assert cache_folder(data, source) != cache_folder(replace(data, max_size=72), source)
    assert cache_folder(data, source) == cache_folder(data, replace(source, scenes=9))
    assert cache_folder(replace(data, weights="one"), source) != cache_folder(replace(data, weights="other"), source)


def make_recorder() -> Surveyor:
    return Recorder()


@pytest.mark.slow
def test_several_workers_make_the_samples_that_one_makes(tmp_path: Path) -> None:
    """Each sample once, with the same bits, whoever makes it."""
    data = DataSettings((SMALL_ROOMS,), cache=str(tmp_path / "one"), encoder="surveyor", max_size=66)
    several = replace(data, cache=str(tmp_path / "several"))
    seen: list[float] = []
    prepare_samples(data, make_recorder, progress=lambda text, fraction: None)
    two = Workers(2)
    found = prepare_samples(several, make_recorder, engine=two, progress=lambda text, fraction: seen.append(fraction))
    assert (found.ready, found.failed) == (4, ())
    assert seen == [0.25, 0.5, 0.75, 1.0]
    for path in cache_folder(data, SMALL_ROOMS).iterdir():
        other = cache_folder(several, SMALL_ROOMS) / path.name
        assert path.read_bytes() == other.read_bytes()


def test_caches_of_earlier_versions_are_found(tmp_path: Path) -> None:
    data = DataSettings((SMALL_ROOMS,), cache=str(tmp_path), encoder="classical", max_size=66)
    assert cache_folder(data, SMALL_ROOMS).name == "procedural-65b79d3face0"
    assert cache_folder(data, replace(SMALL_ROOMS, varied=True)) != cache_folder(data, SMALL_ROOMS)


def test_the_draw_of_a_step_depends_on_seed_step_and_place_in_the_batch_alone(tmp_path: Path) -> None:
    data = training(tmp_path).data
    one, again, other = CachedSamples(data, 1), CachedSamples(data, 1), CachedSamples(data, 2)
    assert isinstance(one, Samples)
    draws = [Draw(step, index, (1, 9)) for step in range(20) for index in (0, 1)]
    found = [one.path(draw) for draw in draws]
    assert found[::-1] == [again.path(draw) for draw in reversed(draws)]
    assert found != [other.path(draw) for draw in draws]
    assert found[::2] != found[1::2]
    assert set(found) == set(cache_folder(data, data.sources[0]).glob("*.safetensors"))
    with pytest.raises(QuerySplatError, match="no source has samples of 5 to 6 inputs"):
        one.path(Draw(0, 0, (5, 6)))
    read, path = one.get(draws[0], following=draws[1])
    assert path == found[0]
    assert torch.equal(read.views.images, read_sample(found[0]).views.images)
    ahead, _ = one.get(draws[1])
    assert torch.equal(ahead.views.images, read_sample(found[1]).views.images)


def test_each_stage_has_samples_of_its_own_inputs(tmp_path: Path) -> None:
    """All samples of the paper's first stage have four inputs, in the cache as well."""
    config = load_config("paper")
    found = [source.inputs for source in sources_of_stages(config.data, config.stages)]
    assert found == [(4, 4), (2, 12)]
    data = DataSettings((SourceSettings("procedural", inputs=(3, 7)),), cache=str(tmp_path))
    stages = (StageSettings(1, 1.0, inputs=(5, 9)), StageSettings(1, 1.0, inputs=(8, 9)))
    assert [source.inputs for source in sources_of_stages(data, stages)] == [(5, 7)]


def test_a_sample_in_the_frame_of_its_first_view_is_the_same_scene() -> None:
    """Inputs, targets and points of the depth move together, and the first camera becomes the origin."""
    before = sample(0)
    after = before.in_frame("first_view")
    assert before.in_frame("predicted") is before
    assert not torch.allclose(before.cameras.w2c[0], torch.eye(4), atol=0.1)
    torch.testing.assert_close(after.cameras.w2c[0], torch.eye(4), atol=1e-6, rtol=0)
    one, other = (each.target_cameras.w2c[1] @ each.cameras.w2c[1].inverse() for each in (before, after))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


SMALL_ROOMS = SourceSettings("procedural", scenes=4, size=(60, 66), inputs=(2, 5), targets=1, cameras="posed")


class Recorder(Surveyor):
    """An encoder without cameras of its own that keeps the pictures of each pass."""

    def __init__(self, fails: int = 0) -> None:
        super().__init__()
        self.pictures: list[np.ndarray] = []
        self._fails = fails

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        if self._fails:
            self._fails -= 1
            raise ImpossibleScene("nothing overlaps")
        self.pictures.append(photos[0].pixels)
        assert request.known
        cameras = [request.known[photo.name] for photo in photos]
        height, width = photos[0].pixels.shape[:2]
        w2c = torch.stack([torch.from_numpy(camera.w2c).float() for camera in cameras])
        K = torch.stack(
            [
                torch.tensor([[c.focal[0], 0, c.principal[0]], [0, c.focal[1], c.principal[1]], [0, 0, 1]])
                for c in cameras
            ]
        )
        images = torch.stack([torch.from_numpy(photo.pixels).permute(2, 0, 1).float() / 255 for photo in photos])
        names, sizes = tuple(photo.name for photo in photos), ((height, width),) * len(photos)
        views = Views(images, torch.ones(len(photos), height, width, dtype=torch.bool), names, sizes)
        nothing = tuple(torch.zeros(0, dtype=torch.long) for _ in photos)
        return PosedViews(views, Cameras(w2c, K, height, width), torch.zeros(0, 3), nothing)


def test_without_a_cache_every_draw_is_of_other_inputs_and_repeatable(tmp_path: Path) -> None:
    data = DataSettings((SMALL_ROOMS,), online=True, cache=str(tmp_path / "none"), max_size=66)
    encoder = Recorder()
    samples = OnlineSamples(data, 3, lambda: encoder)
    draws = [Draw(step, index, (2, 4)) for step in range(3) for index in (0, 1)]
    found = [samples.get(draw) for draw in draws]
    assert {path for _, path in found} == {None}
    assert {len(sample.views) for sample, _ in found} <= {2, 3, 4}
    assert len({sample.views.images.sum().item() for sample, _ in found}) == len(draws)
    again, _ = OnlineSamples(data, 3, Recorder).get(draws[4])
    assert torch.equal(again.views.images, found[4][0].views.images)
    assert torch.equal(again.target_cameras.w2c, found[4][0].target_cameras.w2c)
    assert not (tmp_path / "none").exists()
    four, _ = samples.get(Draw(9, 0, (4, 4)))
    assert len(four.views) == 4


def test_a_scene_that_gives_no_sample_is_drawn_again() -> None:
    data = DataSettings((SMALL_ROOMS,), online=True, max_size=66)
    samples = OnlineSamples(data, 0, lambda: Recorder(fails=2))
    samples.get(Draw(0, 0, (2, 2)))
    assert samples.redrawn == 2
    with pytest.raises(ImpossibleScene, match="20 scenes in a row gave no sample; the last one: nothing overlaps"):
        OnlineSamples(data, 0, lambda: Recorder(fails=100)).get(Draw(0, 0, (2, 2)))
    with pytest.raises(QuerySplatError, match="no source has samples"):
        samples.get(Draw(0, 0, (8, 9)))


def test_the_latest_results_are_kept() -> None:
    kept: RecentResults[int] = RecentResults(2)
    made: list[str] = []

    def get(name: str) -> int:
        return kept.get(Path(name), lambda: made.append(name) or len(made))

    assert [get(name) for name in "abacab"] == [1, 2, 1, 3, 1, 4]
