"""What `export` does: one HTML file with a scene, its photos and the viewer. It opens from disk without a network."""

import base64
import gzip
from dataclasses import dataclass
from html import escape

from querysplat_cli.commands.requests import ExportRequest
from querysplat_cli.commands.viewed_scene import ViewedScene, viewed_scene
from querysplat_cli.commands.viewer_files import LICENCES, MODULES, PAGE, START, STYLE, viewer_file
from querysplat_cli.pipeline.gaussian_files import folder_of_scene
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path, refuse_existing, with_name

PHOTO_SIDE = 640
"""Pixels of the longer side of the photos in the file, at most."""


@dataclass(frozen=True)
class Exported:
    """What was written."""

    output: str
    bytes: int
    photos: int


def export_scene(request: ExportRequest) -> Exported:
    """Write the file, whole or not at all. Raises QuerySplatError when the scene cannot be read."""
    scene_path = with_name(request.scene)
    folder = folder_of_scene(scene_path)
    target = request.output or folder.with_name(f"{folder.name}.html")
    if target.suffix.lower() not in (".html", ".htm"):
        raise QuerySplatError(f"{target}: not the name of a page", "Use a name that ends in .html.")
    refuse_existing([target], force=request.force)
    scene = viewed_scene(scene_path)
    if not request.with_photos:
        scene = without_photos(scene)
    page = single_page(scene)
    with atomic_path(target) as draft:
        draft.write_bytes(page)
    return Exported(str(target), len(page), len(scene.photos))


def without_photos(scene: ViewedScene) -> ViewedScene:
    """The scene with the cameras of its photos, but without their pictures."""
    views = [{**view, "photo": None} for view in scene.manifest["views"]]
    return ViewedScene({**scene.manifest, "views": views}, scene.gaussians)


def single_page(scene: ViewedScene) -> bytes:
    """The page with everything that it would ask a server for, in elements that `viewer/start.js` reads."""
    names = ("scene.json", scene.manifest["gaussians"], *scene.photos)
    held = {name: scene.file(name, PHOTO_SIDE) or b"" for name in names}
    held |= {name: viewer_file(name) or b"" for name in MODULES}
    elements = [
        f'<script type="application/gzip" id="{escape(name)}">{_packed(content)}</script>'
        for name, content in held.items()
    ]
    licences = "\n\n".join(_text(name) for name in LICENCES)
    page = _text(PAGE)
    for tag, content in {
        f'<link rel="stylesheet" href="{STYLE}">': f"<style>\n{_text(STYLE)}</style>",
        f'<script src="{START}"></script>': "\n".join([*elements, f"<script>\n{_text(START)}</script>"]),
        "<head>": f"<!-- With three.js and Spark, under these licences:\n\n{licences}\n-->\n<head>",
    }.items():
        assert page.count(tag) == 1
        page = page.replace(tag, content)
    return page.encode()


def _text(name: str) -> str:
    return (viewer_file(name) or b"").decode()


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()
