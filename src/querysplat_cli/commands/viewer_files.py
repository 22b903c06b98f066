"""The files of the viewer's page: our own, and released ones of other projects, unmodified.

`python -m querysplat_cli.commands.viewer_files` fetches the released files from the npm registry (it needs npm), checks
them, and puts them into the package. That is for a change of their versions: the package has them already.
"""

import hashlib
import subprocess
import sys
import tarfile
import tempfile
from functools import cache
from pathlib import Path

VIEWER = Path(__file__).parents[1] / "viewer"
PAGE = "page.html"
STYLE = "page.css"
START = "start.js"
OWN_MODULES = ("cameras.js", "splats.js", "page.js")


THREE, SPARK = "three@0.187.0", "@sparkjsdev/spark@2.2.0"
LICENCES = {"lib/LICENSE-three.txt": (THREE, "LICENSE"), "lib/LICENSE-spark.txt": (SPARK, "LICENSE")}
RELEASED = {
    "lib/three.core.js": (THREE, "build/three.core.js"),
    "lib/three.module.js": (THREE, "build/three.module.js"),
    "lib/OrbitControls.js": (THREE, "examples/jsm/controls/OrbitControls.js"),
    "lib/Pass.js": (THREE, "examples/jsm/postprocessing/Pass.js"),
    "lib/spark.module.min.js": (SPARK, "dist/spark.module.min.js"),
}
"""Our name of each released file: its package on npm, and its path in there."""
CHECKSUMS = VIEWER / "SHA256SUMS"
"""What `sha256sum -c` reads."""
MODULES = (*RELEASED, *OWN_MODULES)
"""What `viewer/start.js` makes known to the browser."""
TYPES = {".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".jpg": "image/jpeg"}
SERVED = frozenset((PAGE, STYLE, START, *MODULES, *LICENCES))


def viewer_file(name: str) -> bytes | None:
    """A file of the page; None where it has none of that name."""
    return (VIEWER / name).read_bytes() if name in SERVED else None


def checksums() -> dict[str, str]:
    """The sha256 of each released file, by our name of it."""
    lines = (line.split() for line in CHECKSUMS.read_text().splitlines())
    return {name: digest for digest, name in lines}


def fetch() -> None:
    """Replace the released files by those of the registry. Exits with a message where a checksum differs."""
    wanted = RELEASED | LICENCES
    with tempfile.TemporaryDirectory() as folder:
        found = {name: _packed(package, path, folder) for name, (package, path) in wanted.items()}
    right = checksums()
    wrong = [name for name, content in found.items() if hashlib.sha256(content).hexdigest() != right.get(name)]
    if wrong:
        sys.exit(f"the registry has other bytes of {', '.join(wrong)}; nothing was written")
    for name, content in found.items():
        (VIEWER / name).write_bytes(content)
        print(name)


@cache
def _archive(package: str, folder: str) -> Path:
    command = ["npm", "pack", "--silent", package]
    printed = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout
    return Path(folder) / printed.split()[-1]


def _packed(package: str, path: str, folder: str) -> bytes:
    with tarfile.open(_archive(package, folder)) as archive:
        member = archive.extractfile(f"package/{path}")
        return member.read() if member else b""


if __name__ == "__main__":
    fetch()
