"""`querysplat view` and `export` without a browser: what the local server answers, and what it refuses."""

import http.client
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from querysplat_cli.cli import run
from querysplat_cli.commands.view_server import serving
from querysplat_cli.commands.viewed_scene import viewed_scene
from querysplat_cli.commands.viewer_files import LICENCES, RELEASED, VIEWER, checksums
from querysplat_cli.pipeline.gaussian_files import write_gaussians
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.gaussians import Gaussians


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    """Three Gaussians at z = 4, without cameras beside them."""
    gaussians = Gaussians(
        torch.tensor([[0.0, 0, 4], [1, 0, 4], [0, 1, 4]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        torch.full((3, 3), 0.1),
        torch.full((3,), 0.9),
        torch.zeros(3, 1, 3),
    )
    write_ply(tmp_path / "three.ply", gaussians)
    return tmp_path / "three.ply"


def get(address: str, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=10)
    connection.request("GET", path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_server_has_the_page_and_the_scene_and_nothing_else(ply: Path) -> None:
    (ply.parent / "secret.txt").write_text("secret")
    with serving(viewed_scene(ply).file, browser=False) as address:
        assert get(address, "/") == (200, (VIEWER / "page.html").read_bytes())
        manifest = json.loads(get(address, "/scene.json")[1])
        assert get(address, f"/{manifest['gaussians']}?0") == (200, ply.read_bytes())
        for path in ("/secret.txt", "/../secret.txt", f"/{ply.parent}/secret.txt", "/%2e%2e/viewer_files.py", "/lib/"):
            assert get(address, path) == (404, b"")
        ply.unlink()
        assert get(address, f"/{manifest['gaussians']}") == (404, b"")
    assert address.startswith("http://127.0.0.1:")


def test_a_page_that_reaches_this_machine_by_another_name_gets_nothing(ply: Path) -> None:
    with serving(viewed_scene(ply).file, browser=False) as address:
        port = urlsplit(address).port
        assert get(address, "/scene.json", f"evil.example:{port}")[0] == 404
        assert get(address, "/scene.json", f"localhost:{port}")[0] == 200


def test_a_scene_without_cameras_is_seen_from_outside_with_y_down(ply: Path) -> None:
    manifest = viewed_scene(ply).manifest
    assert (manifest["views"], manifest["up"], manifest["name"]) == ([], [0.0, -1.0, 0.0], "three")
    outside = torch.tensor(manifest["outside"]["c2w"])
    assert outside[2, 3] < 4
    assert outside[:3, 1] @ torch.tensor(manifest["up"]) < -0.9
    assert manifest["near"] < manifest["depth"][0] < manifest["depth"][1] < manifest["far"]


def test_a_kind_that_the_page_cannot_read_becomes_one_that_it_can(ply: Path, tmp_path: Path) -> None:
    assert run(["convert", str(ply), str(tmp_path / "other.glb"), "-q"]) == 0
    scene = viewed_scene(tmp_path / "other.glb")
    assert (scene.manifest["kind"], scene.manifest["gaussians"]) == ("ply", "scene.ply")
    (tmp_path / "again.ply").write_bytes(scene.file("scene.ply") or b"")
    torch.testing.assert_close(read_ply(tmp_path / "again.ply").means, read_ply(ply).means)


@pytest.mark.parametrize("what", ["ascii", "big-endian", "line ends", "other elements", "new .spz"])
def test_files_that_only_we_read_become_what_the_page_reads(ply: Path, tmp_path: Path, what: str) -> None:
    """Spark reads no ASCII and no .spz of version 4, and takes what stands in a header literally."""
    scene, data = read_ply(ply), PlyData.read(str(ply))
    file = tmp_path / ("other.spz" if what == "new .spz" else "other.ply")
    data.text, data.byte_order = what == "ascii", "=" if what == "ascii" else ">" if what == "big-endian" else "<"
    if what == "other elements":
        data = PlyData([*data.elements, PlyElement.describe(np.zeros(2, [("fov", "<f4")]), "camera")], byte_order="<")
    if what == "new .spz":
        pytest.importorskip("gsply")
        write_gaussians(file, scene, "4")
    else:
        data.write(str(file))
    if what == "line ends":
        header, end, rest = file.read_bytes().partition(b"end_header\n")
        file.write_bytes((header + end).replace(b"\n", b"\r\n") + rest)
    shown = viewed_scene(file)
    assert (shown.manifest["kind"], shown.manifest["gaussians"]) == ("ply", "scene.ply")
    assert isinstance(shown.gaussians, bytes)  # and not the file itself
    (tmp_path / "shown.ply").write_bytes(shown.gaussians)
    assert viewed_scene(tmp_path / "shown.ply").gaussians == tmp_path / "shown.ply"
    torch.testing.assert_close(read_ply(tmp_path / "shown.ply").means, scene.means, atol=1e-5, rtol=0)


def test_a_port_that_is_taken_is_refused(ply: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(viewed_scene(ply).file, browser=False) as address:
        port = str(urlsplit(address).port)
        assert run(["view", str(ply), "--no-browser", "--port", port]) == ExitCode.BAD_INPUT
    assert f"port {port}" in capsys.readouterr().err


@contextmanager
def viewing(ply: Path, browser: str) -> Iterator["subprocess.Popen[str]"]:
    """`view` of a scene, which has said its address, with BROWSER. It ends by Ctrl-C."""
    command = [sys.executable, "-m", "querysplat_cli", "view", str(ply), "--json"]
    environment = {**os.environ, "BROWSER": browser, "PYTHONUNBUFFERED": ""}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr
    while "Ctrl-C ends it" not in process.stderr.readline():
        assert process.poll() is None
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


def test_view_says_its_address_and_ends_with_ctrl_c(ply: Path) -> None:
    """BROWSER is a command that leaves a file: the browser was asked for the same address."""
    asked = ply.parent / "asked"
    with viewing(ply, f"sh -c 'echo %s >{asked}'") as process:
        pass
    assert process.stdout
    address = json.loads(process.stdout.read())["address"]
    assert asked.read_text().strip() == address


def test_programs_get_the_address_while_view_runs(ply: Path) -> None:
    with viewing(ply, "true") as process:
        assert process.stdout
        os.set_blocking(process.stdout.fileno(), False)
        assert "address" in json.loads(os.read(process.stdout.fileno(), 1000))


def test_what_the_browser_prints_is_not_part_of_the_json(ply: Path) -> None:
    with viewing(ply, "echo Opening in existing browser session %s") as process:
        pass
    assert process.stdout
    assert "address" in json.loads(process.stdout.read())


def test_export_refuses_other_names_and_existing_files(ply: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", str(ply), "-o", str(ply.with_suffix(".zip"))]) == ExitCode.BAD_INPUT
    assert ".html" in capsys.readouterr().err
    assert run(["export", str(ply), "--json"]) == 0
    done = json.loads(capsys.readouterr().out)
    page = ply.with_suffix(".html")
    assert (done["output"], done["bytes"], done["photos"]) == (str(page), page.stat().st_size, 0)
    assert page.read_text().count("Permission is hereby granted") == 2
    assert run(["export", str(ply)]) == ExitCode.BAD_INPUT
    with pytest.raises(QuerySplatError):
        viewed_scene(page)


def test_the_released_files_are_as_they_were_released() -> None:
    found = {
        str(path.relative_to(VIEWER)): sha256(path.read_bytes()).hexdigest() for path in (VIEWER / "lib").iterdir()
    }
    assert found == checksums()
    assert found.keys() == RELEASED.keys() | LICENCES.keys()
