"""Bad places to run in: another user, no room, little memory, closed streams."""

from collections.abc import Iterator

from hostile.case import ANY, REFUSED, Case
from hostile.sound import Sound

DONE = frozenset({0})
NO_MEMORY = frozenset({4})
WRITTEN = ("out", "out.ply", "out.spz", "out.html", "out.png", "s", "s.ply")
SMALL_DISK = "mkdir full; mount -t tmpfs -o size={}k none full; "
"""A disk that is seen by this command alone."""
EMPTY_AGAIN = "; code=$?; ls -A full | grep -v ^torchinductor_ && exit 99; umount full; rmdir full; exit $code"
CONDITIONS = {
    "no HOME": {"env": {"HOME": None, "XDG_CACHE_HOME": None}},
    "HOME that is not there": {"env": {"HOME": "/nonexistent", "XDG_CACHE_HOME": None}},
    "TMPDIR that is not there": {"env": {"TMPDIR": "/nonexistent"}},
    "caches that cannot be written": {"env": {"XDG_CACHE_HOME": "/dev/null", "MPLCONFIGDIR": "/dev/null"}},
    "another user without a home": {"user": 65534},
    "one core": {"cores": 1, "codes": DONE},
    "files of at most 1 KB": {"limits": {"RLIMIT_FSIZE": 1000}},
    "files of at most 50 KB": {"limits": {"RLIMIT_FSIZE": 50_000}},
    "a full TMPDIR": {
        "shell": SMALL_DISK.format(16) + "export TMPDIR=$PWD/full; {}" + EMPTY_AGAIN,
        "alone": True,
    },
    "8 open files": {"limits": {"RLIMIT_NOFILE": 24}},
    "an address space of 1.2 GB": {"limits": {"RLIMIT_AS": 1_200_000_000}, "codes": NO_MEMORY},
    "an address space of 2 GB": {"limits": {"RLIMIT_AS": 2_048_000_000}, "codes": DONE | NO_MEMORY},
    "closed output": {"shell": "{} >&-", "codes": DONE},
    "closed messages": {"shell": "{} 2>&-", "codes": DONE},
    "everything closed": {"shell": "{} >&- 2>&- <&-", "codes": DONE},
    "a reader of one line": {"shell": "set -o pipefail; {} --json 2>&1 | head -1", "codes": DONE},
    "a reader that goes away": {"shell": "set -o pipefail; {} --json 2>&1 | true", "codes": DONE},
    "an ASCII terminal": {"env": {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}, "codes": DONE},
    "a folder that cannot be written": {"user": 65534, "mode": 0o555, "codes": REFUSED},
}
"""What surrounds a command."""
COMPILED_ANEW = ("another user without a home", "caches that cannot be written")
"""Without a cache, the kernels of `reconstruct` and `tto` are compiled for minutes."""
MANY = ("no HOME", "files of at most 1 KB", "a full TMPDIR", "an address space of 1.2 GB", "closed output")
MANY += ("closed messages", "a reader of one line", "a reader that goes away", "an ASCII terminal")


def situations(sound: Sound) -> Iterator[Case]:
    photo = str(sound.photos / "0.png")
    verbs = {
        "reconstruct": ("reconstruct", photo, "-o", "out.ply", "--tto", "0", "--max-size", "96"),
        "tto": ("tto", "s", "--steps", "1"),
        "render": ("render", "s.ply", "-o", "out", "--size", "32x24"),
        "convert": ("convert", "s.ply", "out.spz"),
        "info": ("info", "s.ply", "--plot", "out.png"),
        "export": ("export", "s.ply", "-o", "out.html"),
        "weights": ("weights",),
        "doctor": ("doctor",),
    }
    for verb, command in verbs.items():
        for what, place in CONDITIONS.items():
            few = verb in ("info", "export", "weights", "doctor") and what not in MANY
            if few or (verb in ("reconstruct", "tto") and what in COMPILED_ANEW):
                continue
            codes = place.get("codes", ANY)
            yield Case("places", f"{verb}: {what}", sound.scene, command, codes, WRITTEN, "process", place)
    for what, (shell, codes) in _scripts(photo).items():
        place = {"shell": shell.replace("querysplat", "{0}"), "alone": "mount" in shell}
        yield Case("places", what, sound.scene, (), codes, (*WRITTEN, "s-inspected"), "process", place)


def _scripts(photo: str) -> dict[str, tuple[str, frozenset[int]]]:
    """Commands with steps around them, and the right exit codes."""
    draft = "--tto 0 --max-size 96 -q"
    commands = {
        "reconstruct": f"querysplat reconstruct {photo} -o full/out.ply {draft}",
        "render": "querysplat render s.ply -o full/out -q",
        "convert": "querysplat convert s.ply full/out.spz -q",
        "export": "querysplat export s.ply -o full/out.html -q",
        "inspect": "querysplat inspect s -o full/out -q",
        "info": "querysplat info s.ply --plot full/out.png -q",
        "demo": "querysplat demo -o full/out --photos 3 -q",
    }
    full = {f"{verb}: a full disk": (SMALL_DISK.format(4) + do + EMPTY_AGAIN, REFUSED) for verb, do in commands.items()}
    view = "timeout -s INT --preserve-status 20 querysplat view s.ply --no-browser"
    return full | {
        "tto .": ("cd s; querysplat tto . --steps 0 -q", DONE),
        "tto s/../s": ("querysplat tto s/../s --steps 0 -q", DONE),
        "inspect .": ("cd s; querysplat inspect . -q", DONE),
        "reconstruct -o s/../s.ply --force": (f"querysplat reconstruct {photo} -o s/../s.ply --force {draft}", DONE),
        "a folder that vanishes": ("mkdir v; cd v; rmdir ../v; querysplat convert ../s.ply out.ply -q", REFUSED),
        "an output folder that vanishes": (
            f"mkdir v; (sleep 4; rm -rf v) & querysplat reconstruct {photo} -o v/out.ply {draft}; code=$?; "
            "wait; rm -rf v; exit $code",
            ANY,
        ),
        "a scene that vanishes": (
            "mkdir v; cp -r s s.ply v; (sleep 3; rm -rf v) & querysplat tto v/s --steps 60 -q; code=$?; "
            "wait; rm -rf v; exit $code",
            ANY,
        ),
        "view: until Ctrl-C": (view, DONE),
        "view: closed output": (f"{view} >&-", DONE),
        "view: a reader that goes away": (f"set -o pipefail; {view} | true", DONE),
        "view: a port that is taken": (
            "python -m http.server --bind 127.0.0.1 8097 2>/dev/null & sleep 2; "
            "querysplat view s.ply --no-browser --port 8097; code=$?; kill %1; exit $code",
            REFUSED,
        ),
        "doctor in an empty environment": ("env -i PYTHONPATH=$PYTHONPATH querysplat doctor", DONE),
    }
