"""Damaged streamed SOGs: folders with the suffix .lod."""

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hostile.case import QUIET, WRITTEN, Case
from hostile.damage import changed_json, damaged, noise
from hostile.sound import Sound

from PIL import Image

INDEX = "lod-meta.json"
CHUNK = "0_0/meta.json"
PICTURES = ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels")
COMMANDS = (
    ("convert", "in.lod", "out.ply", QUIET),
    ("convert", "in.lod", "out.lod", "--levels", "1", QUIET),
    ("info", "in.lod", QUIET),
    ("export", "in.lod", "-o", "out.html", QUIET),
    ("convert", f"in.lod/{INDEX}", "out.spz", QUIET),
)
"""What reads them, in turn."""
Change = Callable[[Path], object]


def levels(sound: Sound) -> Iterator[Case]:
    whole = sound.folder / "few.lod"
    index, chunk, around = (sound.bytes(f"few.lod/{name}") for name in (INDEX, CHUNK, "env/meta.json"))
    lies: list[tuple[str, Change]] = [("sound", lambda folder: None)] * len(COMMANDS)
    lies += [(f"index, {what}", _written(INDEX, content)) for what, content in _index_damage(index)]
    for name, content, count in ((CHUNK, chunk, 40), ("env/meta.json", around, 15)):
        some = (*changed_json(content, name, count), *damaged(content, name, 8, 4, head=200))
        lies += [(f"{name}, {what}", _written(name, changed)) for what, changed in some]
    for picture in PICTURES:
        name = f"0_0/{picture}.webp"
        for what, content in damaged(sound.bytes(f"few.lod/{name}"), name, 4, 2, head=40):
            lies.append((f"{picture}, {what}", _written(name, content)))
    lies += [*_pictures(), *_places(index)]
    written = (*WRITTEN, "out.lod", "out.html", "out.spz")
    for i, (what, change) in enumerate(lies):
        yield Case(".lod", what, _changed(whole, change), COMMANDS[i % len(COMMANDS)], written=written)


def _changed(whole: Path, change: Change) -> Change:
    def write(folder: Path) -> None:
        shutil.copytree(whole, folder / "in.lod")
        change(folder / "in.lod")

    return write


def _written(name: str, content: bytes) -> Change:
    return lambda folder: (folder / name).write_bytes(content)


def _index_damage(index: bytes) -> Iterator[tuple[str, bytes]]:
    yield from changed_json(index, "lod index", 90)
    yield from damaged(index, "lod index", 20, 8)
    yield from noise("lod", 4)
    whole = json.loads(index)
    for number in (0, 1, 10**6, 10**9, 2**63, 10**30):
        yield f"lodLevels {number}", _json({**whole, "lodLevels": number})
    for number in (10**9, 2**63, 10**30):
        yield f"a run of {number}", _json(_everywhere(whole, "count", number))
        yield f"a run from {number}", _json(_everywhere(whole, "offset", number))
        yield f"a run in file {number}", _json(_everywhere(whole, "file", number))
    yield "50,000 names", _json({**whole, "filenames": whole["filenames"] * 10_000})
    leaf = {"bound": whole["tree"]["bound"], "lods": {}}
    yield "100,000 empty leaves", _json({**whole, "tree": {**leaf, "lods": None, "children": [leaf] * 100_000}})
    yield "100,000 empty leaves, no levels", _json({**whole, "tree": _parent(leaf, [leaf] * 100_000)})
    run = {"file": 0, "offset": 0, "count": 0}
    many = _parent(leaf, [{**leaf, "lods": {"0": {**run, "file": i}}} for i in range(20_000)])
    for what, names in (("one file", ["0_0/meta.json"] * 20_000), ("files", [str(i) for i in range(20_000)])):
        yield f"20,000 runs of nothing in {what}", _json({"lodLevels": 1, "filenames": names, "tree": many})
    deep = json.dumps(leaf)
    for _ in range(3000):
        deep = f'{{"bound": {json.dumps(leaf["bound"])}, "children": [{deep}]}}'
    yield "a tree 3,000 deep", json.dumps({**whole, "tree": None}).replace('"tree": null', f'"tree": {deep}').encode()


def _parent(leaf: dict[str, Any], children: list[dict[str, Any]]) -> dict[str, Any]:
    return {"bound": leaf["bound"], "children": children}


def _everywhere(part: Any, key: str, value: object) -> Any:
    """JSON content with another value wherever `key` is in a run."""
    if isinstance(part, list):
        return [_everywhere(each, key, value) for each in part]
    if not isinstance(part, dict):
        return part
    run = "offset" in part
    return {name: value if run and name == key else _everywhere(each, key, value) for name, each in part.items()}


def _json(content: Any) -> bytes:
    return json.dumps(content).encode()


def _pictures() -> Iterator[tuple[str, Change]]:
    """Pictures of other sizes and kinds."""
    for picture in PICTURES:
        for what, size, kind in (("of one pixel", (1, 1), "WEBP"), ("a PNG", (4, 4), "PNG")):
            stream = io.BytesIO()
            Image.new("RGBA", size, (255, 255, 255, 255)).save(stream, kind)
            yield f"{picture} {what}", _written(f"0_0/{picture}.webp", stream.getvalue())
    stream = io.BytesIO()
    Image.new("RGBA", (16383, 16383)).save(stream, "WEBP", lossless=True, quality=0, method=0)
    yield "a picture of 268 million pixels", _written("0_0/means_l.webp", stream.getvalue())


def _places(index: bytes) -> Iterator[tuple[str, Change]]:
    """Names that leave the folder, and things that are no files."""
    for name in ("../evil/meta.json", "/etc/passwd", "..", ".", "0_0", "a\0b", "\ud800/meta.json", "x" * 5000):
        for key in ("filenames", "environment"):
            whole = json.loads(index)
            whole[key] = name if key == "environment" else [name, *whole[key][1:]]
            yield f"{key} {ascii(name)[:24]}", _written(INDEX, _json(whole))
    for name in (INDEX, CHUNK, "env/meta.json", "0_0/means_l.webp"):
        yield f"without {name}", lambda folder, name=name: (folder / name).unlink()
        yield f"a folder for {name}", lambda folder, name=name: _folder(folder / name)
        yield f"a link to itself for {name}", lambda folder, name=name: _link(folder / name)
    yield "an empty folder", lambda folder: (shutil.rmtree(folder), folder.mkdir())
    yield "a file", lambda folder: (shutil.rmtree(folder), folder.write_bytes(index))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)
