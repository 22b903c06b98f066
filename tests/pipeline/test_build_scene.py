"""A scene from given cameras and geometry, without an encoder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from weakref import ref

import pytest
import torch

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import build_scene, encode_and_build
from querysplat_cli.pipeline.full_size import FullSize
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.regions import task
from querysplat_cli.pipeline.regions.scene import RegionTask
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import Target
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Photo, Views
from querysplat_cli.splat.render import render

SIZE = 48
SETTINGS = ReconstructSettings((Path("photos"),), Path("scene.ply"), tto=3)


@dataclass
class GivenGeometry:
    """An encoder that returns a geometry that is there already, and records what it is asked for."""

    geometry: Geometry
    asked: list[tuple[str, ...]] = field(default_factory=list)
    features: list[ref[torch.Tensor]] = field(default_factory=list)
    name: str = "given"
    size: int = SIZE
    own_frame: bool = False

    def estimate_cameras(
        self,
        photos: Sequence[Photo],
        *,
        max_size: int,
        seed: int,
        progress: Progress,
        known: Mapping[str, PhotoCamera] | None = None,
    ) -> PosedViews:
        raise NotImplementedError

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        self.asked.append(posed.views.names)
        rows = [("a", "b", "c", "d").index(name) for name in posed.views.names]
        assert self.geometry.depth is not None
        assert self.geometry.confidence is not None
        features = self.geometry.features[0][rows]
        self.features.append(ref(features))
        return replace(
            self.geometry,
            depth=self.geometry.depth[rows],
            confidence=self.geometry.confidence[rows],
            features=(features,),
        )

    def free(self) -> None:
        self.asked.append(("freed",))

    def bytes_needed(self, views: int, size: int) -> int | None:
        return None


@pytest.fixture(scope="module")
def model() -> QuerySplat:
    return load("compact").requires_grad_(False)


def wall(model: QuerySplat, sideways: Sequence[float]) -> tuple[PosedViews, Geometry]:
    """Views of the plane z = 1 by cameras beside each other, their points and their true depth."""
    count, random = len(sideways), torch.Generator().manual_seed(0)
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = -torch.tensor(sideways)
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]]).repeat(count, 1, 1)
    masks = torch.ones(count, SIZE, SIZE, dtype=torch.bool)
    views = Views(
        torch.rand(count, 3, SIZE, SIZE, generator=random), masks, tuple("abcd"[:count]), ((SIZE, SIZE),) * count
    )
    points = torch.rand(40, 3, generator=random) * torch.tensor([0.4, 0.4, 0.0]) + torch.tensor([-0.2, -0.2, 1.0])
    posed = PosedViews(views, Cameras(w2c, K, SIZE, SIZE), points, (torch.arange(40),) * count)
    depth = torch.ones(count, SIZE, SIZE)
    tokens = torch.randn(count, (SIZE // 6) ** 2, model.config.vgm_width, generator=random)
    return posed, Geometry(depth, depth, (tokens,), patch=6)


def test_a_scene_needs_no_encoder(model: QuerySplat) -> None:
    posed, geometry = wall(model, (-0.1, 0.0, 0.1))
    stages = Stages()
    scene = build_scene(posed, geometry, model, SETTINGS, stages)
    assert list(stages.seconds) == ["queries", "tto"]
    assert [len(result.history) for _, result in scene.adapted.runs] == [3]
    assert scene.posed is posed
    encoder = GivenGeometry(geometry)
    encoded = encode_and_build(posed, encoder, model, SETTINGS, Stages())
    assert encoder.asked == [("a", "b", "c"), ("freed",)]
    pairs = zip(scene.adapted.gaussians.tensors(), encoded.adapted.gaussians.tensors(), strict=True)
    assert all(one.equal(other) for one, other in pairs)


@pytest.mark.parametrize("target", ["kv", "features"])
def test_every_scene_goes_through_the_rounds_of_refinement(model: QuerySplat, target: Target) -> None:
    posed, geometry = wall(model, (-0.1, 0.0, 0.1))
    settings = [replace(SETTINGS, tto=steps, tto_target=target) for steps in (0, 3)]
    found = [build_scene(posed, geometry, model, each).prepared.anchors for each in settings]
    none, few = (anchors.refinement for anchors in found if anchors is not None)
    assert none.any()
    assert none.equal(few)


def test_what_is_far_behind_the_middle_of_the_scene_is_drawn(model: QuerySplat) -> None:
    """Behind a thing at 1 and hills at 40, depth is searched up to 200."""
    posed, geometry = wall(model, (-0.1, 0.0, 0.1))
    posed.views.images[:] = 0.7
    depth = torch.ones(3, SIZE, SIZE)
    depth[:, : SIZE // 2] = 200.0
    scene = build_scene(posed, replace(geometry, depth=depth), model, replace(SETTINGS, tto=0, backdrop=False))
    alpha = render(scene.gaussians, posed.cameras).alpha[:, 6 : SIZE // 2 - 6, 6:-6]
    assert float(alpha.min()) > 0.5


def test_what_follows_the_large_photos_has_the_colour_transforms_found_there(model: QuerySplat) -> None:
    """The backdrop's colours are the photos' without them, as `tto` makes it."""
    scene = build_scene(*wall(model, (-0.1, 0.0, 0.1)), model, SETTINGS)
    now = Exposures.identity(3)
    further = FullSize(scene.gaussians, SIZE, [], {}, interrupted=False, exposures=now)
    assert replace(scene, full_size=further).inputs.exposures is now


@dataclass
class Recorder:
    """A watcher that records what it sees."""

    heard: list[str] = field(default_factory=list)
    seen: list[tuple[Gaussians, Views, Cameras]] = field(default_factory=list)

    def listen(self, stage: str, text: str, fraction: float) -> None:
        self.heard.append(stage)

    def look(self, gaussians: Gaussians, views: Views, cameras: Cameras) -> None:
        self.seen.append((gaussians.detach(), views, cameras))


def test_a_watcher_sees_every_step_and_changes_nothing(model: QuerySplat) -> None:
    posed, geometry = wall(model, (-0.1, 0.0, 0.1))
    stages, watcher = Stages(), Recorder()
    stages.watch(watcher)
    watched = build_scene(posed, geometry, model, SETTINGS, stages)
    assert list(dict.fromkeys(watcher.heard)) == ["queries", "tto"]
    assert [(views.names, len(cameras)) for _, views, cameras in watcher.seen] == [(("a", "b", "c"), 3)] * 3
    assert not watcher.seen[0][0].means.equal(watcher.seen[2][0].means)
    alone = build_scene(posed, geometry, model, SETTINGS)
    pairs = zip(watched.gaussians.tensors(), alone.gaussians.tensors(), strict=True)
    assert all(one.equal(other) for one, other in pairs)


def test_near_duplicates_are_left_out_before_depth_is_estimated(model: QuerySplat) -> None:
    posed, geometry = wall(model, (-0.1, -0.1, 0.0, 0.1))
    encoder = GivenGeometry(geometry)
    scene = encode_and_build(posed, encoder, model, replace(SETTINGS, tto=0), Stages())
    assert encoder.asked == [("a", "c", "d"), ("freed",)]
    assert [(each.name, each.why) for each in scene.duplicates] == [("b", "shows what a shows")]
    kept = encode_and_build(posed, encoder, model, replace(SETTINGS, tto=0, keep_everything=True), Stages())
    assert encoder.asked[2:] == [("a", "b", "c", "d"), ("freed",)]
    assert kept.duplicates == ()


def test_a_region_leaves_no_photo_out(model: QuerySplat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Near-duplicates are found once, ahead of the division: in a region, photos are in another order."""
    posed, geometry = wall(model, (-0.1, -0.1, 0.0, 0.1))
    encoder = GivenGeometry(geometry)
    monkeypatch.setattr(task, "_parts", lambda settings: (model, encoder))
    write_part(tmp_path / task.TASK, RegionTask(posed, 3, {}, replace(SETTINGS, tto=0, quality="draft")))
    task.run_region(tmp_path)
    assert encoder.asked == [("a", "b", "c", "d")]
    assert len(read_part(tmp_path / task.SCENE).depth) == 3


def test_features_are_freed_before_the_scene_is_optimised(model: QuerySplat) -> None:
    posed, geometry = wall(model, (-0.1, 0.0, 0.1))
    held: dict[str, bool] = {}
    encoder = GivenGeometry(geometry)

    def listen(stage: str, text: str, fraction: float) -> None:
        if encoder.features:
            held.setdefault(stage, encoder.features[-1]() is not None)

    encode_and_build(posed, encoder, model, replace(SETTINGS, tto=0), Stages(listen))
    assert held == {"depth": True, "queries": True, "tto": False}
