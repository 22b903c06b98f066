"""Pinhole cameras of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from querysplat_cli.scene.rotations import skew
from querysplat_cli.scene.sim3 import Sim3

SHAPE_TOLERANCE = 0.02
"""By how much rounding their sizes may change the aspect ratio of pictures."""


LONGEST_SIDE = 100_000
"""Pixels of the longer side of the largest picture that a camera may have."""
FOCAL_RANGE = 0.01, 10_000.0
"""Sensible focal lengths in longer sides of the picture: fields of view from 179° down to 20 seconds of arc."""
FARTHEST_PRINCIPAL = 10.0
"""How far from the picture's corner a principal point may lie, in longer sides of the picture."""
STRONGEST_DISTORTION = 20.0
NEAREST_DEPTH = 1e-6
"""Points at a smaller camera z, in scene units, count as behind the camera."""
FARTHEST_CENTRE = 1e12
"""In units of the file. Beyond it, float32 holds no useful difference between two cameras."""


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether pictures of these (height, width) have the same aspect ratio, within rounding."""
    return abs(one[1] * other[0] / (one[0] * other[1]) - 1) <= SHAPE_TOLERANCE


@dataclass(frozen=True)
class PhotoCamera:
    """One photo's camera as other tools describe it: OpenCV world-to-camera, and intrinsics with lens distortion.

    `focal` is (fx, fy), `principal` (cx, cy) in pixels of a photo of `height` × `width`, pixel centres at
    +0.5; `distortion` is OpenCV's (k1, k2, p1, p2), or (k1, k2, k3, k4) of its fisheye model. `file` is the path of the
    photo in the file of cameras, if there is one. `as_stored` is whether its pixels are known to be those that the
    photo's file stores, before EXIF's orientation turns them. `depth_map` is the file that is listed as its depth map.
    """

    w2c: np.ndarray
    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: tuple[float, float, float, float]
    height: int
    width: int
    fisheye: bool = False
    file: str = ""
    as_stored: bool = False
    depth_map: Path | None = None

    @staticmethod
    def pinhole(w2c: np.ndarray, K: np.ndarray, height: int, width: int) -> "PhotoCamera":
        """The camera of a picture without distortion, from its matrices [4, 4] and [3, 3]."""
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        return PhotoCamera(w2c, (fx, fy), (cx, cy), (0.0, 0.0, 0.0, 0.0), height, width)

    @property
    def K(self) -> np.ndarray:
        """The intrinsic matrix [3, 3], without the distortion."""
        return np.array([[self.focal[0], 0, self.principal[0]], [0, self.focal[1], self.principal[1]], [0, 0, 1.0]])

    def fault(self) -> str:
        """Why no camera is like this, or "". A pose that is no rigid motion is no fault here."""
        longer, (low, high) = max(self.height, self.width), FOCAL_RANGE
        if not (min(self.height, self.width) > 0 and longer <= LONGEST_SIDE):
            return f"its picture is {self.width} × {self.height} pixels"
        if not all(low <= focal / longer <= high for focal in self.focal):
            return f"its focal length is {self.focal[0]:g}, {self.focal[1]:g} pixels"
        if not all(abs(place) <= FARTHEST_PRINCIPAL * longer for place in self.principal):
            return f"its principal point is {self.principal[0]:g}, {self.principal[1]:g} pixels"
        if not all(abs(k) <= STRONGEST_DISTORTION for k in self.distortion):
            return f"its lens distortion is {', '.join(f'{k:g}' for k in self.distortion)}"
        if np.abs(np.nan_to_num(self.w2c[:3, 3], nan=0.0, posinf=0.0, neginf=0.0)).max() > FARTHEST_CENTRE:
            return f"it is more than {FARTHEST_CENTRE:g} units from the origin"
        return ""


@dataclass(frozen=True)
class Cameras:
    """Views that share one canvas of `height` × `width` pixels.

    `w2c` are OpenCV world-to-camera matrices (x right, y down, z forward); `K` are in pixels of the
    canvas, pixel centres at +0.5. A photo smaller than the canvas sits in its top-left corner, so its
    intrinsics are those of the photo itself.
    """

    w2c: Float[Tensor, "views 4 4"]
    K: Float[Tensor, "views 3 3"]
    height: int
    width: int

    def __len__(self) -> int:
        return len(self.w2c)

    def __getitem__(self, index: slice | Sequence[int] | Tensor) -> "Cameras":
        return replace(self, w2c=self.w2c[index], K=self.K[index])

    @staticmethod
    def joined(parts: Sequence["Cameras"]) -> "Cameras":
        """The cameras of all `parts`, at least one, in their order. They share one canvas."""
        return replace(parts[0], w2c=torch.cat([part.w2c for part in parts]), K=torch.cat([part.K for part in parts]))

    def of_pictures(self, sizes: Sequence[tuple[int, int]] | None) -> list["Cameras"]:
        """One camera for each view, whose canvas is its picture alone.

        `sizes` are (height, width) of the pictures, each in the top-left corner; with None, all fill the canvas.
        """
        sizes = sizes or [(self.height, self.width)] * len(self)
        each = zip(self.w2c.split(1), self.K.split(1), sizes, strict=True)
        return [replace(self, w2c=w2c, K=K, height=height, width=width) for w2c, K, (height, width) in each]

    @property
    def c2w(self) -> Float[Tensor, "views 4 4"]:
        """Camera-to-world matrices, by transposing the rotation. A general inverse would be less exact."""
        rotation = self.w2c[:, :3, :3].mT
        c2w = torch.zeros_like(self.w2c)
        c2w[:, :3, :3] = rotation
        c2w[:, :3, 3:] = -rotation @ self.w2c[:, :3, 3:]
        c2w[:, 3, 3] = 1
        return c2w

    @property
    def centres(self) -> Float[Tensor, "views 3"]:
        """Camera centres in the world."""
        return self.c2w[:, :3, 3]

    @property
    def intrinsics(
        self,
    ) -> tuple[Float[Tensor, "views"], Float[Tensor, "views"], Float[Tensor, "views"], Float[Tensor, "views"]]:
        """Focal lengths fx and fy, and the principal point cx and cy, in pixels of the canvas."""
        return self.K[:, 0, 0], self.K[:, 1, 1], self.K[:, 0, 2], self.K[:, 1, 2]

    def unproject(
        self, depth: Float[Tensor, "views rows columns"], x: Float[Tensor, "columns"], y: Float[Tensor, "rows"]
    ) -> Float[Tensor, "views rows columns 3"]:
        """World points of the given camera z at pixels (x, y)."""
        fx, fy, cx, cy = (part[:, None, None] for part in self.intrinsics)
        local = torch.stack([(x - cx) / fx * depth, (y[:, None] - cy) / fy * depth, depth], -1)
        c2w = self.c2w
        return torch.einsum("vij,vrcj->vrci", c2w[:, :3, :3], local) + c2w[:, None, None, :3, 3]

    def patch_places(
        self, depth: Float[Tensor, "views height width"], patch: int
    ) -> Float[Tensor, "views rows columns 3"]:
        """World points of the middle pixels of all patches of `patch` × `patch` pixels, from their camera z."""
        middle = patch // 2
        z = depth[:, middle::patch, middle::patch]
        rows, columns = (torch.arange(count) * patch + middle + 0.5 for count in z.shape[1:])
        return self.unproject(z, columns, rows)

    def local(self, points: Float[Tensor, "n 3"], view: int) -> Float[Tensor, "n 3"]:
        """World points in the coordinates of the camera of `view`: x right, y down, z forward."""
        return points @ self.w2c[view, :3, :3].T + self.w2c[view, :3, 3]

    def project(
        self, points: Float[Tensor, "n 3"], view: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Pixels x and y of world points, and camera z. Where z < NEAREST_DEPTH, pixels are finite and mean nothing."""
        fx, fy, cx, cy = (part[view] for part in self.intrinsics)
        x, y, z = self.local(points, view).unbind(1)
        ahead = z.clamp_min(NEAREST_DEPTH)
        return x / ahead * fx + cx, y / ahead * fy + cy, z

    def sees(self, points: Float[Tensor, "n 3"], view: int) -> Bool[Tensor, "n"]:
        """Which world points lie in front of the camera of `view` and inside its picture."""
        w2c = self.w2c[view]
        in_front = points @ w2c[2, :3] + w2c[2, 3] > 0
        pixels = project_points(points[in_front], w2c, self.K[view])
        seen = in_front.clone()
        seen[in_front] = ((pixels >= 0) & (pixels < pixels.new_tensor([self.width, self.height]))).all(1)
        return seen

    def to(self, target: torch.dtype | torch.device | str) -> "Cameras":
        return replace(self, w2c=self.w2c.to(target), K=self.K.to(target))

    def resized(self, height: int, width: int) -> "Cameras":
        """The same cameras for a canvas of another size (each axis scaled on its own)."""
        K = self.K.clone()
        K[:, 0] *= width / self.width
        K[:, 1] *= height / self.height
        return replace(self, K=K, height=height, width=width)

    def perturbed(self, turns: Float[Tensor, "views 3"], shifts: Float[Tensor, "views 3"]) -> "Cameras":
        """Each camera turned about its centre, then with `shifts` added to its translation. Differentiable.

        `turns` are rotation vectors in radians. Both are in the axes of the camera, `shifts` in scene units.
        """
        turned = torch.linalg.matrix_exp(skew(turns)) @ self.w2c[:, :3]
        moved = torch.cat([turned[:, :, :3], turned[:, :, 3:] + shifts[:, :, None]], 2)
        return replace(self, w2c=torch.cat([moved, self.w2c[:, 3:]], 1))

    def zoomed(self, factor: float | Tensor) -> "Cameras":
        """The same cameras with all focal lengths multiplied by `factor`. Differentiable."""
        return replace(self, K=torch.cat([self.K[:, :, :2] * factor, self.K[:, :, 2:]], 2))

    def transformed(self, similarity: Sim3) -> "Cameras":
        """The same cameras in the world that `similarity` maps to (camera axes keep unit length)."""
        w2c = self.w2c.double()
        moved = torch.zeros_like(w2c)
        moved[:, :3, :3] = w2c[:, :3, :3] @ similarity.rotation.T
        moved[:, :3, 3] = similarity.scale * w2c[:, :3, 3] - moved[:, :3, :3] @ similarity.translation
        moved[:, 3, 3] = 1
        return replace(self, w2c=moved.to(self.w2c.dtype))


def distances(some: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]) -> Float[Tensor, "n m"]:
    """How far places are from others, also far from the origin: of more than 25, torch would subtract squares."""
    return torch.cdist(some, others, compute_mode="donot_use_mm_for_euclid_dist")


def nearest_first(centres: Float[Tensor, "views 3"]) -> Int[Tensor, "views views"]:
    """For each camera, the numbers of all by the distance of their centres: mostly itself, and then the nearest."""
    return distances(centres, centres).argsort(dim=1, stable=True)


def project_points(
    points: Float[Tensor, "n 3"], w2c: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 2"]:
    """Pixels of world points that lie in front of the camera."""
    image = (points @ w2c[:3, :3].T + w2c[:3, 3]) @ K.T
    return image[:, :2] / image[:, 2:]


def rescaled(camera: PhotoCamera, height: int, width: int) -> PhotoCamera:
    """The camera of the same photo when it is stored at another size. Corners map to corners."""
    x, y = width / camera.width, height / camera.height
    focal, principal = camera.focal, camera.principal
    return replace(
        camera, focal=(focal[0] * x, focal[1] * y), principal=(principal[0] * x, principal[1] * y),
        height=height, width=width,
    )  # fmt: skip
