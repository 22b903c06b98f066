"""Options at their extremes."""

from collections.abc import Iterator

from hostile.case import ANY, QUIET, REFUSED, WRITTEN, Case
from hostile.damage import drawn
from hostile.sound import Sound

from hypothesis import strategies as st

NINES = "9" * 5000
EXTREMES = ("-1", "0", "1e30", "nan", "inf", "-inf", NINES, "99999999999999999999", "", "x", "0x10", "１２")
OPTIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "reconstruct": (
        ("none.png", "-o", "out.ply"),
        "tto queries max-size max-views holdout-every seed budget frames scale matcher prune quality lens exposure "
        "poses",
    ),
    "render": (("s.ply", "-o", "out"), "frames fps size background seconds cameras"),
    "convert": (("s.ply", "out.ply"), "scale crop up prune remove keep-sphere spz-version photos"),
    "tto": (("s",), "steps lr densify prune exposure"),
    "inspect": (("s", "-o", "out"), "query"),
    "view": (("nowhere.ply", "--no-browser"), "port"),
    "info": (("s.ply",), "plot"),
    "eval": (("captured", "--splits-only", "-o", "out"), "views scales cases shard workers tto sweep cameras max-size"),
    "train": (("--dry-run", "--config", "none.toml"), "set workers device"),
    "demo": (("-o", "s"), "photos seed"),
    "weights": ((), "weights"),
    "poses": (("s", "s"), "seed plot"),
}
"""What is sound of each verb, and the options that get extreme values. Most commands end in the checks; values that are
sound run where that takes no time.
"""
SMALL = {"render": ("size", "16x12"), "tto": ("steps", "0")}
REFUSED_NAMES = (".", "/", "..", "", "x", "x.compressed.ply", "a\0b.ply", "n" * 300 + ".ply", "s.ply/x.ply")


def options(sound: Sound) -> Iterator[Case]:
    values = (*EXTREMES, *(text for text in drawn(st.text(min_size=1, max_size=12), 4) if "\0" not in text))
    for verb, (words, names) in OPTIONS.items():
        given = [str(sound.captured) if word == "captured" else word for word in words]
        small, value_of_small = SMALL.get(verb, ("", ""))
        for option in names.split():
            extra = (f"--{small}", value_of_small) if small and option != small else ()
            for value in values:
                command = (verb, *given, *extra, f"--{option}={value}", QUIET)
                yield Case("options", f"{verb} --{option} {ascii(value)[1:-1][:20]}", sound.scene, command)
    made = ("reconstruct", str(sound.photos / "0.png"), "--force", "--tto", "0", "--max-size", "96", QUIET, "-o")
    for name in (*REFUSED_NAMES, "x.glb", "x.sog"):
        codes, written = (REFUSED, WRITTEN) if name in REFUSED_NAMES else (ANY, (*WRITTEN, name, "x"))
        yield Case("options", f"output {name[:20]!r}", sound.scene, (*made, name), codes, written)
        converted = ("convert", "s.ply", name, "--force", QUIET)
        yield Case("options", f"convert to {name[:20]!r}", sound.scene, converted, codes, written)
