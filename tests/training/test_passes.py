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
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Photo, Views
from querysplat_cli.training.config import DataSettings, SourceSettings
from querysplat_cli.training.data import RecentResults, Samples, cache_folder, prepare_samples
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
    return make_sample(given, INPUTS, encoder, known=None, max_size=64, seed=0)


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
        Samples(data, 0)
    assert cache_folder(data, source) != cache_folder(replace(data, max_size=72), source)
    assert cache_folder(data, source) == cache_folder(data, replace(source, scenes=9))


def test_what_a_step_sees_depends_on_seed_step_and_process_alone(tmp_path: Path) -> None:
    data = training(tmp_path).data
    one, again, other = Samples(data, 1), Samples(data, 1), Samples(data, 2)
    draws = [one.path(step, 0, rank, (1, 9)) for step in range(20) for rank in (0, 1)]
    assert draws[::-1] == [again.path(step, 0, rank, (1, 9)) for step in range(19, -1, -1) for rank in (1, 0)]
    assert draws != [other.path(step, 0, rank, (1, 9)) for step in range(20) for rank in (0, 1)]
    assert draws[::2] != draws[1::2]
    assert set(draws) == set(cache_folder(data, data.sources[0]).glob("*.safetensors"))
    with pytest.raises(QuerySplatError, match="no sample has"):
        one.path(0, 0, 0, (5, 6))
    read = one.read(draws[0], following=draws[1])
    assert torch.equal(read.views.images, read_sample(draws[0]).views.images)


def test_the_latest_results_are_kept() -> None:
    kept: RecentResults[int] = RecentResults(2)
    made: list[str] = []

    def get(name: str) -> int:
        return kept.get(Path(name), lambda: made.append(name) or len(made))

    assert [get(name) for name in "abacab"] == [1, 2, 1, 3, 1, 4]
