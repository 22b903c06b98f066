"""A scene in the browser while a run makes it."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

from querysplat_cli.commands.view_server import serving
from querysplat_cli.commands.viewed_scene import framing, jpeg, view_entries
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.ply import NoGaussian, write_ply
from querysplat_cli.scene.formats.transforms import NamedCameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import eight_bit
from querysplat_cli.scene.views import Views

EVERY_SECONDS = 3.0
"""How often at most the page gets new Gaussians."""
GOODBYE_SECONDS = 5.0
"""How long the end of a run waits for the page to notice it."""
ENDED = "The run has ended. `querysplat view` shows its scene."


@contextmanager
def watched(stages: Stages, name: str, announce: Callable[[str], None]) -> Iterator[None]:
    """Show what `stages` report in the browser meanwhile, under `name`; `announce` is told the address."""
    with scratch_folder() as folder:
        live = LiveView(name, folder / "scene.ply")
        stages.watch(live)
        with serving(live.file, browser=True) as address:
            announce(address)
            yield
            live.end()


class LiveView:
    """The files of the page for a scene that is being made. A `Watcher`; the server asks from other threads."""

    def __init__(self, name: str, ply: Path) -> None:
        self._manifest: dict[str, Any] = {"name": name, "gaussians": None, "version": 0, "live": True, "state": ""}
        self._ply = ply
        self._photos: dict[str, bytes] = {}
        self._views: Views | None = None
        self._lock = threading.Lock()
        self._shown = self._asked = float("-inf")
        self._end_was_read = threading.Event()

    def listen(self, stage: str, text: str, fraction: float) -> None:
        """Show what the run is doing."""
        with self._lock:
            self._manifest["state"] = f"{stage}: {text}" if text else stage

    def look(self, gaussians: Gaussians, views: Views, cameras: Cameras) -> None:
        """Show the Gaussians, unless others were shown a moment ago."""
        if perf_counter() - self._shown < EVERY_SECONDS:
            return
        gaussians, cameras = gaussians.detach().to("cpu"), cameras.to("cpu")
        inputs = NamedCameras(views.names, cameras, views.sizes)
        entries = view_entries(inputs)
        with self._lock:
            try:
                write_ply(self._ply, gaussians)
            except NoGaussian:  # the step is about to be undone
                return
            if views is not self._views:
                self._views, self._photos = views, _photos(views)
            for entry, name in zip(entries, self._photos, strict=True):
                entry["photo"] = name
            self._manifest |= {**framing(gaussians, inputs), "kind": "ply", "gaussians": "scene.ply", "views": entries}
            self._manifest["version"] += 1
        self._shown = perf_counter()

    def end(self) -> None:
        """Say that the run has ended, and wait a little for a page that follows it."""
        with self._lock:
            self._manifest |= {"live": False, "state": ENDED}
            followed = perf_counter() - self._asked < GOODBYE_SECONDS
        if followed:
            self._end_was_read.wait(GOODBYE_SECONDS)

    def file(self, name: str) -> bytes | None:
        """As `ViewedScene.file`."""
        with self._lock:
            if name == "scene.json":
                self._asked = perf_counter()
                if not self._manifest["live"]:
                    self._end_was_read.set()
                return json.dumps(self._manifest).encode()
            if name == self._manifest["gaussians"]:
                return self._ply.read_bytes()
            return self._photos.get(name)


def _photos(views: Views) -> dict[str, bytes]:
    pictures = zip(views.images.cpu(), views.sizes, strict=True)
    return {
        f"photos/{row}.jpg": jpeg(eight_bit(image[:, :height, :width])[..., ::-1])
        for row, (image, (height, width)) in enumerate(pictures)
    }
