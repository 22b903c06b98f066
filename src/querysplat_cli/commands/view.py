"""What `view` does: serve one scene to the browser until Ctrl-C."""

import signal
import threading
from collections.abc import Callable

from querysplat_cli.commands.requests import ViewRequest
from querysplat_cli.commands.view_server import serving
from querysplat_cli.commands.viewed_scene import viewed_scene
from querysplat_cli.runtime import signals


def view_scene(request: ViewRequest, announce: Callable[[str], None]) -> None:
    """Serve the scene, tell `announce` the address, and return after Ctrl-C. Other signals end the command as usual.

    Raises QuerySplatError when the scene cannot be read or the port is taken.
    """
    scene = viewed_scene(request.scene)
    try:
        with serving(scene.file, request.port, browser=request.browser) as address:
            announce(address)
            threading.Event().wait()
    except KeyboardInterrupt:
        if signals.exit_code() != 128 + signal.SIGINT:
            raise
