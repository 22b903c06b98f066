"""Photos are divided into groups, every place has one region, and regions get common colours."""

import math
import sys
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from common.streets import stroll
from querysplat_cli.encoders.base import PosedViews, UsedDepthMaps
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.full_size import LargePhotos
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.parts import with_absolute_parts
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.colours import common_exposures, recoloured
from querysplat_cli.pipeline.regions.groups import Group, divide
from querysplat_cli.pipeline.regions.join import _optimised, join, worse_joined
from querysplat_cli.pipeline.regions.owners import CoreViews, depth_maps, owners
from querysplat_cli.pipeline.regions.scene import KeptRegions, RegionScene
from querysplat_cli.pipeline.regions.seams import Seam, disagreement, find_seams, parts_needed, verdict
from querysplat_cli.pipeline.regions.task import region_task
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import NOT_KNOWN, MemoryMap, PreparedQueries
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.filed_views import FiledViews
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import PhotoSource, Views
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.plan import TtoRun

VIEWS = 20


@pytest.fixture
def street() -> PosedViews:
    """A walk in shuffled order. Each photo sees the points within two metres ahead; a point stands at each 10 cm."""
    order = torch.randperm(VIEWS, generator=torch.Generator().manual_seed(1))
    cameras = stroll(10.0, VIEWS, 3, 30, 40)[order]
    along = torch.arange(0, 12, 0.1)
    points = torch.stack([along, torch.full_like(along, 3.5), torch.full_like(along, 1.6)], 1)
    seen = tuple(((along >= x) & (along <= x + 2)).nonzero()[:, 0] for x in cameras.centres[:, 0].tolist())
    masks = torch.ones(VIEWS, 30, 40, dtype=torch.bool)
    views = Views(torch.zeros(VIEWS, 3, 30, 40), masks, tuple(map(str, range(VIEWS))), ((30, 40),) * VIEWS)
    return PosedViews(views, cameras, points, seen)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_groups_are_stretches_of_the_walk(street: PosedViews, count: int) -> None:
    groups = divide(street, count)
    assert groups == divide(street, count)
    assert sorted(row for group in groups for row in group.core) == list(range(VIEWS))
    assert {len(group.core) for group in groups} <= {VIEWS // count, math.ceil(VIEWS / count)}
    place = street.cameras.centres[:, 0].argsort().argsort()
    for group in groups:
        own, overlap = place[list(group.core)], place[list(group.overlap)]
        assert int(own.max() - own.min()) == len(own) - 1, "a group has a gap"
        if count > 1:
            assert 2 <= len(overlap) <= max(2, math.ceil(len(own) / 4))
            assert all(min(abs(int(each) - int(mine)) for mine in own) <= 3 for each in overlap)


def test_groups_without_points_go_by_the_cameras(street: PosedViews) -> None:
    bare = replace(street, points=street.points[:0], visibility=tuple(part[:0] for part in street.visibility))
    place = street.cameras.centres[:, 0].argsort().argsort()
    for group in divide(bare, 2):
        own = place[list(group.core)]
        assert int(own.max() - own.min()) == len(own) - 1


def test_every_two_groups_with_a_photo_in_common_have_a_seam() -> None:
    groups = (Group((0, 1), (2,)), Group((2, 3), (1, 4)), Group((4, 5), ()))
    assert [(seam.regions, seam.photos) for seam in find_seams(groups)] == [((0, 1), (1, 2)), ((1, 2), (4,))]


def test_photos_are_taken_together_as_far_as_memory_and_time_go(street: PosedViews) -> None:
    photos = LargePhotos(street.views, street.cameras)
    enough = 40 * math.sqrt(PIPELINE_POLICY.joint_pixels / (VIEWS * 30 * 40))
    assert [parts_needed(photos, size) for size in (20, 40, int(enough), int(enough) + 1)] == [1, 1, 1, 2]
    many = [row % VIEWS for row in range(PIPELINE_POLICY.joint_photos + 1)]
    assert [parts_needed(photos.some(rows), 40) for rows in (many[1:], many)] == [1, 2]


def test_regions_that_show_other_things_are_not_joined() -> None:
    """Sound joins have no warning, doubtful ones and those that no picture shows have one, and bad ones are refused."""
    seam = Seam((0, 2), (4,))
    assert verdict(seam, 20.0) is None
    for decibels in (12.0, 0.0):
        assert "regions 1 and 3 show different things" in (verdict(seam, decibels) or "")
    with pytest.raises(ImpossibleScene, match=r"regions 1 and 3 .*\(8\.0 dB\), so they are not joined") as raised:
        verdict(seam, 8.0)
    assert "fewer --regions" in raised.value.hint


def test_pictures_of_unrelated_regions_are_refused() -> None:
    """Two walls of noise at one place: what `disagreement` finds is below what is refused, and 100 dB for the same."""
    chance = torch.Generator().manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(-2, 2, 24), torch.linspace(-1.5, 1.5, 18), indexing="xy")
    means = torch.stack([x, y, torch.full_like(x, 3.0)], -1).reshape(-1, 3)
    count = len(means)

    def wall() -> Gaussians:
        colours = torch.randint(0, 2, (count, 1, 3), generator=chance).float()
        size, turn = torch.full((count, 3), 0.08), torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
        return Gaussians(means, turn, size, torch.full((count,), 0.95), (colours - 0.5) / SH_0)

    one, other = wall(), wall()
    cameras, _ = facing(-0.2, 0.2, depth=3.0)
    seam = Seam((0, 1), (0, 1))
    sizes = [(20, 20), (20, 20)]
    assert disagreement(seam, cameras, sizes, [one, one]) == pytest.approx(100)
    with pytest.raises(ImpossibleScene):
        verdict(seam, disagreement(seam, cameras, sizes, [one, other]))
    left = means[:, 0] < 0  # all that the narrow picture shows
    beyond = replace(one, sh=torch.where(left[:, None, None], one.sh, other.sh))
    assert disagreement(seam, cameras, [(20, 7), (20, 20)], [one, beyond]) > 40
    assert disagreement(seam, cameras, sizes, [one, beyond]) < 15


def facing(*places: float, depth: float) -> tuple[Cameras, torch.Tensor]:
    """Cameras at these x that look along +z, and what they see everywhere at `depth`."""
    w2c = torch.eye(4).repeat(len(places), 1, 1)
    w2c[:, 0, 3] = -torch.tensor(places)
    K = torch.tensor([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]]).repeat(len(places), 1, 1)
    return Cameras(w2c, K, 20, 20), torch.full((len(places), 20, 20), depth)


def test_a_place_belongs_to_the_photo_that_shows_it_largest() -> None:
    views = CoreViews.of([facing(0.0, 1.0, depth=5.0), facing(4.0, depth=2.0)])
    places = torch.tensor([
        [0.5, 0.0, 4.0],  # only the first region shows it
        [3.9, 0.0, 1.9],  # only the second
        [3.0, 0.0, 4.5],  # in pictures of both; behind what the second has there
        [3.5, 0.0, -3.0],  # in no picture: the nearest camera's
        [0.2, 0.0, 9.0],  # behind everything: the nearest camera's
    ])  # fmt: skip
    assert owners(places, views).tolist() == [0, 1, 0, 1, 0]


def region(matrices: torch.Tensor | None) -> RegionScene:
    """One with no Gaussians that matter, whose photos have these transforms."""
    nothing = torch.zeros(0, 1, 1)
    memories = Memories(nothing, nothing, nothing, nothing)
    exposures = None if matrices is None else Exposures(matrices)
    where = MemoryMap(torch.zeros(0).int(), torch.zeros(0).int(), torch.ones(3).int(), torch.zeros(0, 0, 0), NOT_KNOWN)
    prepared = PreparedQueries(memories, None, None, where)
    return RegionScene(grey(), {}, torch.zeros(1, 1, 1), prepared, exposures, None, 1, {})


def grey() -> Gaussians:
    """One Gaussian of the colour (0.5, 0.5, 0.5) whose SH of degree 1 are 0.1."""
    sh = torch.full((1, 4, 3), 0.1)
    sh[:, 0] = 0
    return Gaussians(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1) / 2, sh)


def test_depth_is_that_of_what_covers_a_pixel_in_part() -> None:
    """A wall of opacity 0.7, four units in front of the camera; nothing beside it."""
    wall = Gaussians(
        torch.tensor([[-2.0, 0, 4]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[0.6, 2, 1e-3]]),
        torch.tensor([0.7]),
        torch.zeros(1, 1, 3),
    )
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[10.0, 0, 10], [0, 10, 5], [0, 0, 1]]]), 10, 20)
    depth = depth_maps(wall, camera, [(10, 20)])[0]
    assert depth[5, 5].item() == pytest.approx(4, rel=1e-3)
    assert depth[5, 18].isinf()
    narrow = depth_maps(wall, camera, [(8, 12)])[0]
    assert torch.equal(narrow[:8, :12], depth[:8, :12])
    assert not narrow[8:].any()
    assert not narrow[:, 12:].any()


def test_regions_get_common_colours() -> None:
    """A true scene in photos of known exposure: the regions' own colours differ, and agree afterwards."""
    gain = torch.tensor([0.7, 0.9, 1.1, 1.3]).double()
    photos = torch.zeros(4, 3, 4).double()
    photos[:, :, :3] = gain[:, None, None] * torch.eye(3).double()
    photos[:, :, 3] = 0.02
    groups = (Group((0, 1), (2,)), Group((2, 3), (1,)))
    scenes = [region(Exposures(photos[list(group.rows)]).with_identity_mean().matrices) for group in groups]
    exposures, transforms = common_exposures(groups, scenes, 4)
    assert exposures is not None
    torch.testing.assert_close(exposures.matrices, Exposures(photos).with_identity_mean().matrices)
    for number, group in enumerate(groups):
        mine = recoloured(grey(), transforms[number])
        for row, own in zip(group.rows, scenes[number].exposures.matrices, strict=True):  # type: ignore[union-attr]
            before = own[:, :3] @ torch.full((3,), 0.5).double() + own[:, 3]
            colour = 0.5 + SH_0 * mine.sh[0, 0].double()
            after = exposures.matrices[row, :, :3] @ colour + exposures.matrices[row, :, 3]
            torch.testing.assert_close(before, after, atol=1e-5, rtol=0)
    assert common_exposures(groups, [region(None), region(None)], 4)[0] is None


def test_a_task_has_no_path_of_the_current_folder(
    street: PosedViews, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker of Dask has another current folder, and so may the run that goes on."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.safetensors").touch()
    given = ReconstructSettings((), Path(), preset="my.safetensors", weights=Path("weights"), lpips=Path("lpips"))
    sources = {name: PhotoSource(Path(f"{name}.jpg")) for name in street.views.names}
    task = region_task(street, divide(street, 2)[0], with_absolute_parts(given), sources)
    assert task.sources == {name: PhotoSource(tmp_path / f"{name}.jpg") for name in task.posed.views.names}
    found = task.settings
    assert found.preset == str(tmp_path / "my.safetensors")
    assert (found.weights, found.lpips) == (tmp_path / "weights", tmp_path / "lpips")
    assert with_absolute_parts(replace(given, preset="compact")).preset == "compact"


def test_ctrl_c_in_the_last_optimisation_ends_the_run(street: PosedViews, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be lost in the parts after it, and the kept regions with it."""
    taken = []

    def interrupted(rows: list[int], *rest: object, **more: object) -> tuple[Gaussians, TtoRun, SimpleNamespace]:
        taken.append(rows)
        return grey(), TtoRun("gaussians", TtoSettings(1, 0.1)), SimpleNamespace(interrupted=True)

    monkeypatch.setattr(sys.modules[join.__module__], "smoothed", interrupted)
    photos = LargePhotos(street.views, street.cameras)
    with pytest.raises(KeyboardInterrupt):
        _optimised(divide(street, 2), photos, 40, grey(), 42, lambda text, fraction: None)
    assert len(taken) == 1


def test_parts_are_kept_and_damaged_ones_are_made_again(street: PosedViews, tmp_path: Path) -> None:
    file = tmp_path / "part.pt"
    assert read_part(file) is None
    write_part(file, street)
    again = read_part(file)
    assert torch.equal(again.cameras.w2c, street.cameras.w2c)
    assert again.views.names == street.views.names
    file.write_bytes(file.read_bytes()[:1000])
    assert read_part(file) is None
    torch.save({"code": print}, file)
    assert read_part(file) is None


def test_regions_that_the_whole_shows_much_worse_have_a_warning() -> None:
    def entry(alone: float, joined: float) -> dict[str, Any]:
        return {"quality": {"psnr": alone}, "joined": {"psnr": joined}}

    fine = entry(28.0, 25.5)
    assert worse_joined([fine, fine]) == []
    (one,) = worse_joined([fine, entry(28.0, 18.0)])
    assert "photos of region 2 up to 10.0 dB worse" in one
    (two,) = worse_joined([entry(28.0, 24.0), fine, entry(28.0, 18.0)])
    assert "photos of regions 1, 3 up to 10.0 dB worse" in two


def test_two_regions_are_in_memory_at_a_time(street: PosedViews, tmp_path: Path) -> None:
    """Four regions of one wall along the walk are joined from what is read of them, again and again."""
    street = replace(street, views=FiledViews(street.views, tmp_path / "inputs.views"))
    groups = divide(street, 4)
    x, z = torch.meshgrid(torch.linspace(-2, 14, 60), torch.linspace(0, 3, 12), indexing="xy")
    means = torch.stack([x, torch.full_like(x, 4.0), z], -1).reshape(-1, 3)
    size, turn = torch.full((len(means), 3), 0.1), torch.tensor([[1.0, 0, 0, 0]]).expand(len(means), 4)
    alive: list[weakref.ref[torch.Tensor]] = []
    most = 0

    def read(number: int) -> RegionScene:
        nonlocal most
        wall = Gaussians(means.clone(), turn, size, torch.full((len(means),), 0.9), torch.zeros(len(means), 1, 3))
        alive.append(weakref.ref(wall.means))
        most = max(most, sum(each() is not None for each in alive))
        core = street.cameras[list(groups[number].core)]
        entries = {"quality": {}, "tto": [], "full_size": None, "warnings": [], "process_peak_gib": float(number)}
        maps = UsedDepthMaps((0, 1, len(core)), (1, len(core)), 0.01, 2.0) if number else None
        alone = region(None)
        depth = depth_maps(wall, core, [(core.height, core.width)] * len(core))
        return replace(alone, gaussians=wall, depth=depth, size=40, entries=entries | {"depth_maps": maps})

    settings = ReconstructSettings((), Path(), backdrop=False)
    built = join(street, groups, KeptRegions(read), settings, {}, lambda text, fraction: None)
    assert most == 2
    assert built.peak_gib == 3
    assert len(built.scene.gaussians) == len(means)
    assert sum(entry["gaussians"] for entry in built.regions) == len(means)
    assert sorted(name for names in built.own for name in names) == sorted(street.views.names)
    assert len(built.seams) == 3
    assert all(entry["psnr"] == pytest.approx(100) for entry in built.seams)
    assert built.scene.full_size
    maps = built.scene.geometry.depth_maps
    assert maps
    assert maps.entry() == {"given": 6, "used": 3, "difference": 0.01, "per_unit": 2.0}
    assert maps.used == tuple(group.core[1] for group in groups[1:])
    assert all("depth_maps" not in entry for entry in built.regions)
    (last,) = built.scene.full_size.runs
    assert last["steps"] == PIPELINE_POLICY.joint_passes * VIEWS, "photos far from every seam take part, too"
