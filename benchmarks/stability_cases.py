"""The stiff and extreme scenes that the splatter is tried on. docs/reference/stability-cases.md lists their kinds."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import RenderSettings
from scenes import camera, cloud, single, stacked

import torch

IMAGE, GRADIENT = 1e-5, 1e-4
"""Largest errors of a case that states no others."""
SQUARE = math.sqrt(0.5)
TURNS = {"across the view": [1.0, 0, 0, 0], "along the view": [SQUARE, 0, SQUARE, 0], "askew": [0.8, 0.1, -0.3, 0.5]}
"""Quaternions by the direction of a needle's longest axis."""
CROWD = 1_000_000


@dataclass(frozen=True)
class Case:
    """One scene.

    `expect` is one of: agree (with the reference); nothing (every Gaussian is culled, and every gradient is exactly 0);
    refuse (an error with a clear message). `image` and `gradient` are the largest errors allowed. `flips` is the share
    of pixels that may differ by up to two steps of 1/255, because an alpha at the cut-off falls to either side.
    """

    family: str
    what: str
    gaussians: Gaussians
    cameras: Cameras
    expect: str = "agree"
    image: float = IMAGE
    gradient: float = GRADIENT
    flips: float = 0.0
    note: str = ""
    settings: RenderSettings = field(default_factory=RenderSettings)


def cases() -> Iterator[Case]:
    """Every scene of the table."""
    small = camera(24, 32)
    yield from _rotations_and_shapes(small)
    yield from _places(small)
    yield from _opacities(small)
    yield from _order_and_absence(small)
    yield from _pictures(small)
    yield from _units(small)
    yield from _numbers(small)
    yield from _crowds()


def away(gaussians: Gaussians, cameras: Cameras, distance: float) -> tuple[Gaussians, Cameras]:
    """Scene and camera moved together, `distance` along each axis."""
    shift = torch.full((3,), distance, dtype=torch.float64)
    w2c = cameras.w2c.clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ shift
    return replace(gaussians, means=gaussians.means + shift), replace(cameras, w2c=w2c)


def rounded(case: Case) -> Case:
    """The case with float32 numbers, which the kernel and the reference both read."""
    return replace(case, gaussians=case.gaussians.to(torch.float32).to(torch.float64))


def _rotations_and_shapes(small: Cameras) -> Iterator[Case]:
    for length in (1e-20, 1e20):
        turned = single(quats=[0.5 * length, -0.5 * length, 0.1 * length, 0.7 * length], scales=[0.5, 0.1, 0.02])
        yield Case("rotation", f"quaternion of length {length:g}", turned, small)
    yield Case("rotation", "quaternion of length 0", single(quats=[0.0] * 4), small, "nothing")
    for name, turn in TURNS.items():
        needle = single(quats=turn, scales=[1.0, 1e-4, 1e-8])
        yield Case("shape", f"needle 1 : 1e-4 : 1e-8, {name}", needle, camera(48, 48), gradient=2e-4)
    disc = single(quats=TURNS["along the view"], scales=[0.5, 0.5, 1e-7])
    yield Case("shape", "disc seen edge-on, thickness 1e-7", disc, small)
    yield Case("size in the picture", "1e12 times the picture", single(scales=[1e12] * 3), small)
    yield Case("size in the picture", "a speck of 1e-12", single(scales=[1e-12] * 3), small)
    yield Case("size in the picture", "scale e⁴⁰", single(scales=[math.exp(40)] * 3), small)
    for text, scales in (("e⁴⁵", [math.exp(45)] * 3), ("0 along one axis", [0.3, 0, 0.3]), ("3e38", [3e38, 0.1, 0.1])):
        yield Case("size in the picture", f"scale {text}", single(scales=scales), small, "nothing")


def _places(small: Cameras) -> Iterator[Case]:
    beyond = 1.01 * RenderSettings.far
    places = {0.0: "at the camera", 1e-7: "1e-7 in front of it", -3.0: "behind it", beyond: "beyond the far plane"}
    for z, place in places.items():
        yield Case("place of a centre", place, single(means=[0.0, 0, z]), small, "nothing")
    near = single(means=[0.0, 0, 0.025], scales=[0.0025] * 3)
    yield Case("place of a centre", "on the near plane", near, small)
    wide = _changed(camera(32, 32, field_of_view=120), cx=3.2)
    scene = cloud(60, 60, wide, pixels=4.0)
    scene.means[:, :2] *= 2.5
    yield Case("place of a centre", "far off-axis, 120°, cx at 0.1", scene, wide, gradient=1e-3, flips=0.005)


def _opacities(small: Cameras) -> Iterator[Case]:
    for opacity in (1 / 255, 1 - 1e-9, 1.0):
        scene = single(opacities=opacity)
        yield Case("opacity", f"opacity {opacity:.10g}", scene, small, note="α is capped at 0.99", flips=1.0)
    for opacity in (0.0, 1 / 256):
        yield Case("opacity", f"opacity {opacity:.4g}", single(opacities=opacity), small, "nothing")
    yield Case("opacity", "α in (0.99, 1)", single(opacities=0.995), small, note="no gradient through the cap")
    pixel = camera(1, 1)
    opaque = cloud(10_000, 10_000, pixel, opacity=(0.9, 1), pixels=1)
    yield Case("many on one pixel", "10,000 opaque ones", opaque, pixel, flips=1.0, gradient=1e-3)
    faint = cloud(10_000, 10_000, pixel, opacity=(1 / 254, 1 / 250), pixels=30)
    yield Case("many on one pixel", "10,000 of opacity 1/254 to 1/250", faint, pixel, flips=1.0, gradient=5e-3)


def _order_and_absence(small: Cameras) -> Iterator[Case]:
    red, blue = [[1.0, -2, -2]], [[-2.0, -2, 1]]
    pair = stacked(single(sh=red), single(sh=blue))
    yield Case("order", "equal depths keep their given order", pair, small)
    swap = stacked(single(sh=red), single(means=[0, 0, 3 + 1e-6], sh=blue))
    yield Case("order", "two at depths 1e-6 apart", swap, small)
    copies = stacked(*[single(opacities=0.01)] * 1000)
    note = "gradients nearly cancel"
    yield Case("order", "a thousand copies of one Gaussian", copies, small, gradient=2e-4, note=note)
    yield Case("nothing to draw", "no Gaussians", cloud(0, 0, small), small, "nothing")
    yield Case("nothing to draw", "none in view", single(means=[0.0, 50, 3]), small, "nothing")


def _pictures(small: Cameras) -> Iterator[Case]:
    for height, width, flips in ((1, 1, 0.002), (17, 33, 0.002), (4096, 8, 0.005)):
        odd = camera(height, width)
        note = "float32 resolves row 4,096 to 1/4,096 px" if height == 4096 else ""
        what, scene = f"{height} × {width} pixels", cloud(100, 100, odd, pixels=3)
        yield Case("camera", what, scene, odd, flips=flips, gradient=1e-3, note=note)
    for angle in (1.0, 170.0):
        seen = camera(24, 32, field_of_view=angle)
        yield Case("camera", f"field of view {angle:g}°", cloud(80, 80, seen), seen, flips=0.003, gradient=1e-3)
    odd = _changed(small, cx=40.0, fy=0.6 * float(small.K[0, 1, 1]))
    what = "principal point outside, fx ≠ fy"
    yield Case("camera", what, cloud(150, 150, odd), odd, flips=0.003, gradient=1e-3)


def _units(small: Cameras) -> Iterator[Case]:
    distant = away(cloud(60, 60, small), small, 1e6)
    yield Case("units of the scene", "1e6 units from the origin", *distant, flips=0.005, gradient=1e-3)
    for scale in (1e-6, 1e6):
        grown, limits = _sized(cloud(60, 60, small), scale)
        what = f"scene of size {scale:g}"
        yield Case("units of the scene", what, grown, small, settings=limits, flips=0.005, gradient=1e-3)


def _numbers(small: Cameras) -> Iterator[Case]:
    wild = stacked(single(sh=[[1e10, -1e10, 0]]), single())
    note = "colours are clamped to [0, 1e6]"
    yield Case("range of numbers", "SH of ±1e10 beside a moderate Gaussian", wild, small, note=note)
    for value in (math.nan, math.inf):
        yield Case("range of numbers", f"{value} in a centre", single(means=[value, 0, 3.0]), small, "refuse")


def _crowds() -> Iterator[Case]:
    pixel = camera(1, 1)
    many = cloud(CROWD, CROWD, pixel, pixels=0.5, opacity=(1 / 255, 0.02), degree=0)
    yield Case("crowd", "a million in one tile", many, pixel, flips=1.0, gradient=5e-3)
    large = replace(many, scales=many.scales * 1e6, opacities=many.opacities * 0 + 0.9)
    yield Case("crowd", "a million that each cover 4,096 tiles", large, camera(1024, 1024), "refuse")


def _changed(cameras: Cameras, **entries: float) -> Cameras:
    """`cameras` with other fx, fy, cx or cy."""
    K = cameras.K.clone()
    for name, value in entries.items():
        K[:, int(name[1] == "y"), 2 if name[0] == "c" else int(name[1] == "y")] = value
    return replace(cameras, K=K)


def _sized(gaussians: Gaussians, scale: float) -> tuple[Gaussians, RenderSettings]:
    """The scene `scale` times as large, seen from the same place, and near and far planes to match."""
    near, far = RenderSettings.near * scale, RenderSettings.far * scale
    grown = replace(gaussians, means=gaussians.means * scale, scales=gaussians.scales * scale)
    return grown, RenderSettings(near=near, far=far)
