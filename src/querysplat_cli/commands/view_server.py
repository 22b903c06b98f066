"""A local server for the viewer's page. It answers on 127.0.0.1 only, and has no files but those of one scene."""

import os
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from querysplat_cli.commands.viewer_files import PAGE, TYPES, viewer_file
from querysplat_cli.runtime.errors import QuerySplatError

HOST = "127.0.0.1"
Files = Callable[[str], bytes | None]
"""Gives the content of a scene's file by the name that the page uses."""


@contextmanager
def serving(files: Files, port: int = 0, *, browser: bool) -> Iterator[str]:
    """Serve the page with the scene `files` meanwhile; gives the page's address, and opens the browser if asked to.

    Port 0 is any free one. Raises QuerySplatError when the port is taken.
    """
    try:
        server = _Server((HOST, port), _Handler)
    except OSError as error:
        raise QuerySplatError(
            f"port {port} of {HOST} cannot be used: {error.strerror}", "Leave --port out for any free port."
        ) from None
    server.files = files
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    address = f"http://{HOST}:{server.server_port}/"
    try:
        if browser:
            with _output_as_messages():
                webbrowser.open(address)
        yield address
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def _output_as_messages() -> Iterator[None]:
    """Inside, what programs print goes to standard error. Standard output belongs to --json."""
    output = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(output, 1)
        os.close(output)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    files: Files

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing where the browser went away in the middle of an answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

    def do_GET(self) -> None:
        name = unquote(urlsplit(self.path).path).lstrip("/") or PAGE
        # A page of another site could reach 127.0.0.1 under a name of its own.
        content = self._content(name) if self._is_ours() else None
        self.send_response(404 if content is None else 200)
        self.send_header("Content-Type", TYPES.get(PurePosixPath(name).suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(len(content or b"")))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content or b"")

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: standard error belongs to the command."""

    def _content(self, name: str) -> bytes | None:
        own = viewer_file(name)
        try:
            return self.server.files(name) if own is None else own
        except FileNotFoundError:  # the scene was moved while it was shown
            return None

    def _is_ours(self) -> bool:
        port = self.server.server_port
        return self.headers.get("Host") in (f"{HOST}:{port}", f"localhost:{port}")
