"""A dataset to evaluate on, made on the spot: a ray-cast room in DL3DV's form."""

import json
from pathlib import Path

import cv2

from querysplat_cli.scene.formats.transforms_frame import opengl_from_opencv
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room


def write_room(home: Path, count: int, *, seed: int = 3, size: int = 192) -> None:
    """`home`/transforms.json and `count` photos in `home`/images_4, `size` pixels wide."""
    scene = make_room(seed)
    cameras = walk(scene, count, seed)
    cameras = cameras.resized(round(cameras.height * size / cameras.width), size)
    (home / "images_4").mkdir(parents=True)
    frames = []
    for i in range(count):
        picture = (cast(scene, cameras[[i]], samples=1)[0][0] * 255).round().byte().permute(1, 2, 0).numpy()
        cv2.imwrite(str(home / "images_4" / f"frame_{i + 1:05d}.png"), picture[..., ::-1])
        matrix = opengl_from_opencv(cameras.w2c[i].double().numpy()).tolist()
        frames.append({"file_path": f"images/frame_{i + 1:05d}.png", "transform_matrix": matrix})
    K = 4 * cameras.K[0].double()
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    content = {"w": 4 * cameras.width, "h": 4 * cameras.height, **{key: float(value) for key, value in lens.items()}}
    (home / "transforms.json").write_text(json.dumps({**content, "camera_model": "OPENCV", "frames": frames}))
