"""Two photos: the lens keeps to its prior, and a plane is reconstructed as one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import arc, camera, photographs, room

from querysplat_cli.encoders.classical import two_views
from querysplat_cli.encoders.classical.camera_warnings import camera_warnings
from querysplat_cli.encoders.classical.dense_agreement import dense_agreement
from querysplat_cli.encoders.classical.lens_prior import usual_focal
from querysplat_cli.encoders.classical.mapping import Mapped
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.several_lenses import few_refined
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.encoders.classical.two_views import map_two_photos
from querysplat_cli.encoders.classical.verified_pairs import Pair
from querysplat_cli.scene.cameras import PhotoCamera

SIZE = (480, 640)
PRIOR_FOCAL = CAMERA_POLICY.usual_focal * SIZE[1]


def cameras(focal: float, distortion: float = 0.0) -> list[PhotoCamera]:
    lens = (distortion, 0.0, 0.0, 0.0)
    places = (((-1.0, 0, 0), 0.0), ((1.2, 0.3, 0.4), 0.1))
    return [camera(place, (0, 0, 5), roll, size=SIZE, focal=focal, distortion=lens) for place, roll in places]


def pixels(points: np.ndarray, one: PhotoCamera) -> np.ndarray:
    local = points @ one.w2c[:3, :3].T + one.w2c[:3, 3]
    flat = local[:, :2] / local[:, 2:]
    stretch = 1 + one.distortion[0] * (flat**2).sum(1, keepdims=True)
    return np.asarray(one.focal[0] * flat * stretch + one.principal)


def matches(
    points: np.ndarray,
    two: list[PhotoCamera],
    *,
    stated: float | None,
    wrong: int = 0,
    noise: float = 0.3,
    whole: tuple[int, int] | None = None,
) -> Matches:
    """Matches of the points with a scatter of `noise` pixels, and `wrong` ones anywhere, in photos cut from `whole`."""
    generator = np.random.default_rng(3)
    sides = [pixels(points, each) + noise * generator.standard_normal((len(points), 2)) for each in two]
    random = [generator.uniform(0, [SIZE[1], SIZE[0]], (wrong, 2)) for _ in two]
    first, second = (np.concatenate(parts) for parts in zip(sides, random, strict=True))
    features = (len(first),) * 2
    usual = (usual_focal(*(whole or SIZE)),) * 2
    return Matches(Path(), (SIZE,) * 2, (stated,) * 2, usual, features, (Pair(0, 1, first, second),))


def mapped(found: Matches, agreement: Callable[[SparseModel], float] = lambda model: 0.0) -> SparseModel | None:
    two = map_two_photos(found.pairs[0], found.sizes, found.focals, found.expected_focals, agreement)
    return two[0] if two else None


def cloud(count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform([-1.6, -1.2, 3.5], [1.6, 1.2, 7], (count, 3))


def plane(count: int) -> np.ndarray:
    """A wall that leans away, so that the two solutions of its homography differ."""
    across = np.random.default_rng(2).uniform(-1.5, 1.5, (count, 2))
    return np.column_stack([across, 5 + 0.5 * across[:, 0]])


def turn_error(found: dict[int, PhotoCamera], truth: list[PhotoCamera]) -> float:
    """Degrees between the found and the true relative rotation."""
    turns = [two.w2c[:3, :3] @ one.w2c[:3, :3].T for one, two in ((found[0], found[1]), tuple(truth))]
    return float(np.degrees(np.arccos(np.clip((np.trace(turns[0] @ turns[1].T) - 1) / 2, -1, 1))))


@pytest.mark.parametrize("wrong", [0, 30])
def test_stated_focal_length_and_wrong_matches(wrong: int) -> None:
    truth = cameras(610.0)
    model = mapped(matches(cloud(120), truth, stated=610.0, wrong=wrong))
    assert model is not None
    assert turn_error(model.cameras, truth) < 0.5
    assert model.cameras[0].focal[0] == pytest.approx(610, rel=0.03)
    assert 110 < len(model.points) < 130


@pytest.mark.parametrize("ratio", [0.8, 1.0, 1.25])
def test_the_lens_keeps_to_the_prior_where_twenty_points_say_little(ratio: float) -> None:
    truth = cameras(PRIOR_FOCAL * ratio)
    model = mapped(matches(cloud(20), truth, stated=None))
    assert model is not None
    lens = model.cameras[0]
    assert abs(np.log(lens.focal[0] / PRIOR_FOCAL)) < CAMERA_POLICY.usual_focal_spread
    assert abs(lens.distortion[0]) < CAMERA_POLICY.distortion_spread[0]
    assert turn_error(model.cameras, truth) < 12


@pytest.mark.parametrize("stated", [None, PRIOR_FOCAL])
def test_a_plane_is_reconstructed_as_one(stated: float | None) -> None:
    truth = cameras(PRIOR_FOCAL)
    found = matches(plane(150), truth, stated=stated, noise=0.15)
    model = mapped(found)
    assert model is not None
    assert len(model.points) > 140
    assert turn_error(model.cameras, truth) < 2
    assert model.cameras[0].focal[0] == pytest.approx(PRIOR_FOCAL, rel=0.05)
    offset = model.points - model.points.mean(0)
    assert np.linalg.svd(offset, compute_uv=False)[2] < 0.03 * np.linalg.svd(offset, compute_uv=False)[1]
    if stated is None:
        said = " ".join(camera_warnings(model, found))
        assert "one plane" in said
        assert "hardly determine" in said
        given = " ".join(camera_warnings(model, found, known=True))
        assert "one plane" not in given
        assert "hardly determine" not in given


@pytest.mark.parametrize("zoom", [1.0, 1.25, 1.7])
def test_a_zoomed_photo_beside_another_one_gets_a_lens_of_its_own(zoom: float) -> None:
    """Nothing states that one of both is zoomed."""
    one, two = cameras(PRIOR_FOCAL)[0], cameras(zoom * PRIOR_FOCAL)[1]
    found = matches(cloud(150), [one, two], stated=None)
    model = mapped(found)
    assert model is not None
    first, second = (model.cameras[i].focal[0] for i in (0, 1))
    assert (first == second) is (zoom == 1)
    assert second / first == pytest.approx(zoom, rel=0.04)
    assert turn_error(model.cameras, [one, two]) < 7
    said = few_refined(Mapped(model, found.pairs), found)[1]
    assert bool(said) is (zoom != 1)


def test_each_of_two_lenses_has_its_focal_length() -> None:
    """A wide and a narrow lens, whose EXIF states both."""
    one, two = cameras(480.0)[0], cameras(720.0)[1]
    found = matches(cloud(150), [one, two], stated=None)
    both = replace(found, focals=(480.0, 720.0))
    model = mapped(both)
    assert model is not None
    assert [model.cameras[i].focal[0] for i in (0, 1)] == pytest.approx([480, 720], rel=0.04)
    assert turn_error(model.cameras, [one, two]) < 0.5


def test_photos_that_were_cut_have_the_lens_of_the_whole() -> None:
    """A plane does not determine a focal length, so it is that of the prior, here of photos four times as wide."""
    found = matches(plane(150), cameras(600.0), stated=None, whole=(480, 2560))
    model = mapped(found)
    assert model is not None
    assert model.cameras[0].focal[0] == pytest.approx(CAMERA_POLICY.usual_focal * 2560, rel=0.2)


def test_too_few_matches_make_no_model() -> None:
    assert mapped(matches(cloud(8), cameras(600.0), stated=600.0)) is None


def test_a_poor_start_is_adjusted_until_it_explains_no_more_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turned by 2.3° and of a wrong focal length, it explains a few matches at first, and 177 after two rounds."""
    truth = cameras(PRIOR_FOCAL)
    pose = (truth[1].w2c @ np.linalg.inv(truth[0].w2c))[:3]
    pose[:, :3] = cv2.Rodrigues(np.radians([0, 0, 2.3]))[0] @ pose[:, :3]
    pose[:, 3] /= np.linalg.norm(pose[:, 3])
    focals = np.full(2, 1.3 * PRIOR_FOCAL)
    monkeypatch.setattr(two_views, "_starts", lambda *_: iter([(focals, pose)]))
    model = mapped(matches(cloud(200), truth, stated=None))
    assert model is not None
    assert len(model.points) == 200


@pytest.mark.parametrize(("share", "taken"), [(0.2, True), (0.14, False)])
def test_pixels_decide_between_both_poses_of_a_plane(share: float, taken: bool) -> None:
    """The pose that costs more is taken where half as many pixels again agree with it, and not for less."""
    truth = cameras(PRIOR_FOCAL)
    found = matches(plane(25), truth, stated=PRIOR_FOCAL, noise=1.5)
    cheapest = mapped(found)
    assert cheapest is not None
    asked: list[float] = []

    def prefers_another(model: SparseModel) -> float:
        asked.append(turn_error(model.cameras, [cheapest.cameras[0], cheapest.cameras[1]]))
        return share if asked[-1] > 1 else 0.1

    chosen = mapped(found, prefers_another)
    assert chosen is not None
    assert len(asked) > 1
    assert asked[0] < 0.01
    assert (turn_error(chosen.cameras, [cheapest.cameras[0], cheapest.cameras[1]]) > 1) is taken


def test_pixels_are_not_asked_where_one_pose_explains_the_matches() -> None:
    def never(model: SparseModel) -> float:
        raise AssertionError("there was no doubt")

    assert mapped(matches(cloud(120), cameras(610.0), stated=610.0), never) is not None


def test_photos_agree_with_their_own_cameras() -> None:
    """With the second camera turned by 6°, far fewer pixels agree."""
    two = arc(5)[1:4:2]
    photos = photographs(room(), two)
    points = np.random.default_rng(4).uniform([-1.9, -0.8, 4.0], [-0.6, 0.8, 4.6], (60, 3))
    rows = np.arange(len(points))
    shares = []
    for turn in (0.0, 0.1):
        turned = two[1].w2c.copy()
        turned[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0] @ turned[:3, :3]
        model = SparseModel({0: two[0], 1: replace(two[1], w2c=turned)}, points, {0: rows, 1: rows})
        shares.append(dense_agreement(photos, model))
    assert shares[0] > 0.4
    assert shares[0] > CAMERA_POLICY.rival_agreement * shares[1]
