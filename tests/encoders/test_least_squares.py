"""Bundle adjustment with priors: exact derivatives, and priors that many points outvote and few do not."""

from dataclasses import replace

import numpy as np
import pytest

from querysplat_cli.encoders.classical.least_squares import (
    Bundle,
    LensPrior,
    Loss,
    Observations,
    adjust,
    linearised,
    objective,
    place_points,
    project,
)

FOCAL, SIZE = 400.0, (480, 640)
LOSS = Loss(0.5)


def scene(points: int, *, cameras: int = 2, noise: float = 0.0, seed: int = 0) -> tuple[Bundle, Observations]:
    """Cameras half a unit apart that look along z, and points 3 to 7 units away, with their noisy pixels."""
    generator = np.random.default_rng(seed)
    poses = np.tile(np.eye(3, 4), (cameras, 1, 1))
    for number in range(cameras):
        angle = 0.12 * number
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        poses[number] = np.column_stack([turn, turn @ [-0.5 * number, 0.1 * number, 0.05 * number]])
    lens = np.array([[np.log(FOCAL), SIZE[1] / 2, SIZE[0] / 2, 0.05, -0.02]])
    places = generator.uniform([-2, -1.5, 3], [2, 1.5, 7], (points, 3))
    bundle = Bundle(poses, np.zeros(cameras, int), lens, places)
    camera, point = np.repeat(np.arange(cameras), points), np.tile(np.arange(points), cameras)
    seen = Observations(np.zeros((cameras * points, 2)), camera, point)
    pixels = project(bundle, seen)[0] + noise * generator.standard_normal((cameras * points, 2))
    return bundle, replace(seen, pixels=pixels)


def prior(focal: float, spread: float, weight: float = 1.0) -> LensPrior:
    mean = np.array([[np.log(focal), SIZE[1] / 2, SIZE[0] / 2, 0.0, 0.0]])
    return LensPrior(mean, np.array([[spread, 6.4, 6.4, 0.1, 0.1]]), weight)


def numeric(bundle: Bundle, seen: Observations, field: str, column: int) -> np.ndarray:
    """Central differences of the residuals [n, 2] by one column of all rows of a field."""
    step = 1e-6 * np.eye(getattr(bundle, field).shape[1])[column]
    ends = [replace(bundle, **{field: getattr(bundle, field) + sign * step}) for sign in (1, -1)]
    return (linearised(ends[0], seen).residuals - linearised(ends[1], seen).residuals) / 2e-6


def test_derivatives_by_lens_and_point_are_those_of_finite_differences() -> None:
    bundle, seen = scene(20, cameras=3, noise=1.0)
    linear = linearised(bundle, seen)
    for column in range(5):
        assert linear.lens[:, :, column] == pytest.approx(numeric(bundle, seen, "lenses", column), abs=1e-5)
    for column in range(3):
        assert linear.point[:, :, column] == pytest.approx(numeric(bundle, seen, "points", column), abs=1e-5)


def test_derivatives_by_pose_are_those_of_finite_differences() -> None:
    """A small pose step turns camera coordinates x by ω × x and shifts them by τ."""
    bundle, seen = scene(20, cameras=3, noise=1.0)
    linear, step = linearised(bundle, seen), 1e-6
    for column in range(6):
        ends = []
        for sign in (1, -1):
            poses = bundle.poses.copy()
            if column < 3:
                poses += sign * step * np.cross(np.eye(3)[column], poses, axisb=1, axisc=1)
            else:
                poses[:, column - 3, 3] += sign * step
            ends.append(linearised(replace(bundle, poses=poses), seen).residuals)
        assert linear.pose[:, :, column] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4)


def test_an_exact_scene_stays() -> None:
    bundle, seen = scene(60)
    adjusted = adjust(bundle, seen, prior(FOCAL, 0.3, weight=1e-9), LOSS)
    assert adjusted.lenses == pytest.approx(bundle.lenses, abs=1e-3)
    assert objective(adjusted, seen, prior(FOCAL, 0.3, weight=1e-9), LOSS) < 1e-6


def test_a_disturbed_scene_comes_back() -> None:
    bundle, seen = scene(80, cameras=4)
    generator = np.random.default_rng(1)
    start = replace(
        bundle,
        lenses=bundle.lenses + np.array([[0.1, 3.0, -3.0, -0.05, 0.02]]),
        points=bundle.points + 0.05 * generator.standard_normal(bundle.points.shape),
    )
    adjusted = adjust(start, seen, prior(FOCAL, 1.0, weight=1e-6), LOSS, most_steps=100, tolerance=1e-9)
    assert np.exp(adjusted.lenses[0, 0]) == pytest.approx(FOCAL, rel=1e-3)
    assert np.abs(project(adjusted, seen)[0] - seen.pixels).max() < 0.01


def test_data_and_prior_share_a_difference_by_their_precisions() -> None:
    """Of log f alone, data have the precision Σ(f·ρ)² and the prior has 1/σ²: the mean weighs both."""
    bundle, seen = scene(30)
    held = LensPrior(bundle.lenses + np.array([[0.002, 0, 0, 0, 0]]), np.array([[0.0006, 1, 1, 1, 1]]), 1.0)
    precision, stiffness = (linearised(bundle, seen).lens[:, :, 0] ** 2).sum(), 1 / 0.0006**2
    shifts = np.linspace(0, 0.002, 4001)
    costs = [
        objective(replace(bundle, lenses=bundle.lenses + np.array([[shift, 0, 0, 0, 0]])), seen, held, Loss(1e6))
        for shift in shifts
    ]
    share = stiffness / (stiffness + precision)
    assert 0.1 < share < 0.9
    assert shifts[int(np.argmin(costs))] == pytest.approx(0.002 * share, abs=2e-6)


@pytest.mark.parametrize(("points", "outvoted"), [(20, False), (400, True)])
def test_many_points_outvote_the_prior_and_twenty_do_not(points: int, *, outvoted: bool) -> None:
    """EXIF states 480 pixels with a spread of 3 %, where 400 is right. Features scatter by half a pixel."""
    bundle, seen = scene(points, cameras=6, noise=0.5)
    start = replace(bundle, lenses=np.array([[np.log(480.0), SIZE[1] / 2, SIZE[0] / 2, 0.0, 0.0]]))
    adjusted = adjust(start, seen, prior(480.0, 0.03), LOSS, most_steps=100)
    focal = float(np.exp(adjusted.lenses[0, 0]))
    assert (abs(focal - FOCAL) < 0.25 * 80) == outvoted
    assert (abs(focal - 480) < 0.25 * 80) == (not outvoted)


def test_wrong_matches_hardly_count() -> None:
    bundle, seen = scene(200, cameras=3, noise=0.2)
    pixels = seen.pixels.copy()
    pixels[::15] += 30
    adjusted = adjust(bundle, replace(seen, pixels=pixels), prior(FOCAL, 0.3), LOSS)
    assert np.exp(adjusted.lenses[0, 0]) == pytest.approx(FOCAL, rel=0.02)


def test_points_that_two_equal_cameras_see_do_no_harm() -> None:
    """Nothing determines their distance, so the equations are singular but for the damping."""
    bundle, seen = scene(40)
    same = replace(bundle, poses=np.stack([bundle.poses[0]] * 2))
    pixels = project(same, seen)[0] + 0.1 * np.random.default_rng(4).standard_normal(seen.pixels.shape)
    start = objective(same, replace(seen, pixels=pixels), prior(FOCAL, 0.3), LOSS)
    adjusted = adjust(same, replace(seen, pixels=pixels), prior(FOCAL, 0.3), LOSS)
    assert np.isfinite(adjusted.points).all()
    assert objective(adjusted, replace(seen, pixels=pixels), prior(FOCAL, 0.3), LOSS) <= start


def test_points_are_placed_for_given_cameras() -> None:
    bundle, seen = scene(50, cameras=3)
    moved = bundle.points + 0.03 * np.random.default_rng(2).standard_normal(bundle.points.shape)
    placed = place_points(replace(bundle, points=moved), seen, LOSS)
    assert placed.points == pytest.approx(bundle.points, abs=1e-3)
    assert placed.poses is bundle.poses
