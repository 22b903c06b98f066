"""Procedural scenes with true cameras, photographed as by a phone."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.captures import Capture, drawn_views
from querysplat_cli.training.config import SourceSettings
from querysplat_cli.training.outdoors import make_fence, make_outdoors
from querysplat_cli.training.photographer import cast, wander
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.solids import Scene
from querysplat_cli.training.surfaces import with_dark_and_glossy
from querysplat_cli.training.tabletops import make_tabletop


class Procedural:
    """Ray-cast scenes with true cameras, photographed as by a phone: noise, exposure, white balance, blur, JPEG.

    With `varied`, still lifes on tables are among the scenes, and fences, dark and glossy things.
    """

    def __init__(self, settings: SourceSettings) -> None:
        self._settings = settings

    def __len__(self) -> int:
        return self._settings.scenes

    def name(self, scene: int) -> str:
        return f"{scene:06d}"

    def capture(self, scene: int, draw: int) -> Capture:
        settings = self._settings
        chance = np.random.default_rng([settings.seed, scene, draw])
        # Twice as many cameras as photos, so that inputs may be next to one another or apart.
        frames = 2 * (settings.inputs[1] + settings.targets)
        inputs, targets = drawn_views(chance, settings, frames)
        side = int(chance.integers(settings.size[0], settings.size[1] + 1))
        height, width = round(side * chance.uniform(*TRAINING_POLICY.aspect)), side
        if chance.random() < TRAINING_POLICY.portrait_share:
            height, width = width, height
        made, cameras = self._scene(chance, frames, height, width)
        photos, known = [], {}
        imperfections = _Imperfections.drawn(chance, varied=settings.varied)
        for frame in sorted({*inputs, *targets}):
            image = cast(made, cameras[[frame]])[0][0].permute(1, 2, 0).numpy()
            pixels = imperfections.photograph(image, chance)
            name = f"{frame:03d}.jpg"
            photos.append(Photo(name, Path(name), pixels))
            w2c, K = cameras.w2c[frame].double().numpy(), cameras.K[frame].double().numpy()
            known[name] = PhotoCamera.pinhole(w2c, K, height, width)
        names = tuple(f"{frame:03d}.jpg" for frame in inputs)
        return Capture(tuple(photos), names, known if settings.cameras == "posed" else None)

    def _scene(self, chance: np.random.Generator, frames: int, height: int, width: int) -> tuple[Scene, Cameras]:
        """A scene with free space for a camera path, and the cameras on that path."""
        for _ in range(TRAINING_POLICY.scene_tries):
            seed = int(chance.integers(2**31))
            made = varied_scene(seed) if self._settings.varied else plain_scene(seed, chance)
            try:
                return made, wander(made, frames, seed, height, width)
            except ValueError:
                continue
        raise QuerySplatError(f"no scene of seed {self._settings.seed} has room for a camera path")


def plain_scene(seed: int, chance: np.random.Generator) -> Scene:
    """A room, or things in the open."""
    return make_room(seed) if chance.random() < TRAINING_POLICY.room_share else make_outdoors(seed)


def varied_scene(seed: int) -> Scene:
    """A room, things in the open, or things on a table; some with fences, dark or glossy surfaces."""
    chance = np.random.default_rng([seed, 3])
    make = (make_room, make_outdoors, make_tabletop)[int(chance.integers(3))]
    made = make(seed)
    solids = with_dark_and_glossy(made.solids, chance)
    if make is make_outdoors and chance.random() < TRAINING_POLICY.fence_share:
        solids = (*solids, *make_fence(chance))
    return replace(made, solids=solids)


@dataclass(frozen=True)
class _Imperfections:
    """What a phone's camera does to a picture. The policy's fields of these names give the units."""

    exposure: float
    noise: float
    blur: float
    quality: int
    balance: float

    @staticmethod
    def drawn(chance: np.random.Generator, *, varied: bool) -> "_Imperfections":
        policy = TRAINING_POLICY
        return _Imperfections(
            exposure=float(chance.choice(policy.varied_exposures if varied else policy.exposures)),
            noise=float(chance.uniform(*(policy.varied_noise if varied else policy.noise))),
            blur=float(chance.uniform(*(policy.varied_blur if varied else policy.blur))),
            quality=int(chance.integers(*policy.jpeg_quality, endpoint=True)),
            balance=float(chance.choice(policy.white_balances)) if varied else 0.0,
        )

    def photograph(self, picture: np.ndarray, chance: np.random.Generator) -> np.ndarray:
        """8-bit RGB [height, width, 3] of a picture in [0, 1]."""
        gain = np.exp(self.exposure * (chance.normal() + 0.3 * chance.normal(size=3)))
        if self.balance:
            gain = gain * np.exp(self.balance * chance.normal(size=3))
        soft = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), self.blur)
        grainy = soft * gain + chance.normal(0, 1, picture.shape) * self.noise * np.sqrt(np.clip(soft, 0.02, 1))
        pixels = np.rint(np.clip(grainy, 0, 1) * 255).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.quality]
        packed = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), quality)[1]
        found = cv2.imdecode(packed, cv2.IMREAD_COLOR)
        assert found is not None
        return np.ascontiguousarray(found[..., ::-1])
