"""Settings of SuperSplat's viewer, so that it opens a scene at the view of a photo.

Facts from @playcanvas/supersplat-viewer 1.36.2: the viewer reads a `settings.json`, by default beside its page, and
stands at the first of its cameras. Without one it stands outside of the box of all Gaussians. Its documentation calls
`fov` the vertical field of view; its page takes it along the longer side of the window. Its world is that of the
Gaussians, turned by 180° around z. Its camera is upright, with y up, and looks at `target` in the middle of the window.
"""

import math
from pathlib import Path

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.files import write_json
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import first_shown, scene_middle
from querysplat_cli.scene.sim3 import Sim3

TURNED = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
"""From the frame of the Gaussians to the viewer's."""
LEAST_FOV, LARGEST_FOV = 10.0, 120.0
"""Degrees that the viewer takes."""
EFFECTS = {
    "sharpness": {"enabled": False, "amount": 0},
    "bloom": {"enabled": False, "intensity": 0.1, "blurLevel": 2},
    "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {"enabled": False, "intensity": 0.5},
}
"""All off. The viewer wants them stated."""


def write_supersplat(
    path: Path, gaussians: Gaussians, cameras: Cameras, sizes: tuple[tuple[int, int], ...], frame: Sim3 | None
) -> None:
    """Write the settings that show `gaussians` from the camera that `first_shown` names.

    `sizes` are heights and widths of the pictures on the cameras' canvas. The viewer turns around the point in the
    middle of that picture that is as deep as the middle of the scene. `frame` maps the frame of Gaussians and cameras
    to that of the file of the scene (None: they are one).
    """
    row = first_shown(cameras)
    camera, (height, width) = cameras[[row]].to(torch.float64), sizes[row]
    fx, fy, cx, cy = (float(part[0]) for part in camera.intrinsics)
    middle = scene_middle(gaussians).double()
    depth = float(camera.local(middle[None], 0)[0, 2]) or 1.0
    ray = torch.tensor([(width / 2 - cx) / fx, (height / 2 - cy) / fy, 1.0], dtype=torch.float64)
    points = torch.stack([camera.centres[0], camera.centres[0] + abs(depth) * camera.c2w[0, :3, :3] @ ray])
    position, target = (TURNED * (frame.apply(points) if frame else points)).tolist()
    side, focal = (width, fx) if width > height else (height, fy)
    fov = min(max(math.degrees(2 * math.atan(side / 2 / focal)), LEAST_FOV), LARGEST_FOV)
    settings = {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [0.5] * 3},
        "postEffectSettings": EFFECTS,
        "animTracks": [],
        "cameras": [{"initial": {"position": position, "target": target, "fov": fov}}],
        "annotations": [],
        "startMode": "default",
    }
    write_json(path, settings)
