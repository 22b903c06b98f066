"""Ways to damage a sound file of any kind, and JSON. Everything is repeatable from a seed."""

import json
import random
from collections.abc import Iterator
from typing import Any

from hypothesis import Phase, given, settings
from hypothesis import strategies as st


def damaged(sound: bytes, name: str, flips: int, cuts: int, *, head: int | None = None) -> Iterator[tuple[str, bytes]]:
    """The bytes with one to eight of them changed, half of the times within the first `head`; and cut off."""
    for i in range(flips):
        rng = random.Random(f"{name} {i}")
        changed = bytearray(sound)
        reach = min(len(sound), head or len(sound)) if i % 2 else len(sound)
        for _ in range(rng.randint(1, 8)):
            changed[rng.randrange(reach)] = rng.randrange(256)
        yield f"bytes changed, {i}", bytes(changed)
    for i in range(cuts):
        yield f"cut to {i} of {cuts} parts", sound[: len(sound) * i // cuts]


def noise(name: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Random bytes, 0 to 4,000 of them."""
    for i in range(count):
        rng = random.Random(f"{name} noise {i}")
        yield f"random bytes, {i}", rng.randbytes(rng.randrange(4000))


VALUES: tuple[Any, ...] = (
    0, -111, 1e-300, 1e30, 10**400, float("nan"), float("inf"), 2**63, True, None, "", "x", "9" * 50,
    [], {}, [[]], "\ud800", "../../etc/passwd", ".", "..", "/", "a\0b",
)  # fmt: skip
"""What a value in a JSON file is replaced by. Each of them is wrong for most values."""


def places(content: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every value in JSON content; of long lists only the first two."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield (*way, key)
            yield from places(value, (*way, key))
    elif isinstance(content, list):
        for key, value in enumerate(content[:2]):
            yield (*way, key)
            yield from places(value, (*way, key))


def changed_json(sound: bytes, name: str, count: int) -> Iterator[tuple[str, bytes]]:
    """One value replaced, or removed, or a key renamed; and nesting, digits and repetition."""
    content = json.loads(sound)
    ways = list(places(content))
    for i in range(count):
        rng = random.Random(f"{name} json {i}")
        way, value = rng.choice(ways), rng.choice((*VALUES, "remove", "rename"))
        copy = json.loads(sound)
        inner = copy
        for key in way[:-1]:
            inner = inner[key]
        if value == "remove":
            del inner[way[-1]]
        elif value == "rename" and isinstance(inner, dict):
            inner[f"{way[-1]}?"] = inner.pop(way[-1])
        else:
            inner[way[-1]] = value
        yield f"{'.'.join(map(str, way))} = {ascii(value)[:30]}", json.dumps(copy).encode()
    yield "nested 100,000 times", b"[" * 100_000
    yield "objects nested 100,000 times", b'{"a":' * 100_000
    yield "a number of 5,000 digits", b'{"frames": [' + b"9" * 5000 + b"]}"
    yield "not UTF-8", sound.replace(b"a", b"\xff")
    yield "UTF-16", sound.decode().encode("utf-16")
    yield "an empty file", b""
    yield "null", b"null"


def drawn(strategy: st.SearchStrategy[Any], count: int) -> list[Any]:
    """What hypothesis draws of a strategy; the same in each run."""
    found: list[Any] = []

    @settings(max_examples=count, derandomize=True, database=None, phases=[Phase.generate], deadline=None)
    @given(strategy)
    def collect(value: Any) -> None:
        found.append(value)

    collect()
    return found


def drawn_json(sound: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    """JSON by hypothesis: the keys of a sound file in any order and nesting, with values of any type."""
    keys = st.sampled_from(sorted({str(way[-1]) for way in places(json.loads(sound))}))
    numbers = st.integers() | st.floats() | st.sampled_from([value for value in VALUES if isinstance(value, float)])
    leaves = st.none() | st.booleans() | numbers | st.text(max_size=20)
    values = st.recursive(
        leaves, lambda inner: st.lists(inner, max_size=5) | st.dictionaries(keys, inner, max_size=6), max_leaves=40
    )
    for i, value in enumerate(drawn(st.dictionaries(keys, values, min_size=1, max_size=12), count)):
        yield f"drawn {i}", json.dumps(value).encode()


def drawn_ply(count: int) -> Iterator[tuple[str, bytes]]:
    """.ply files by hypothesis: any elements and properties, and any bytes after the header."""
    kinds = st.sampled_from(["float", "double", "uchar", "int", "list uchar int", "list float float", "x"])
    names = st.sampled_from(["x", "y", "z", "opacity", "f_dc_0", "f_rest_0", "scale_0", "rot_0", "red"]) | st.text(
        max_size=5
    )
    properties = st.tuples(kinds, names).map(lambda pair: f"property {pair[0]} {pair[1]}")
    elements = st.tuples(st.sampled_from(["vertex", "face", "chunk"]), st.integers(-1, 2**65)).map(
        lambda pair: f"element {pair[0]} {pair[1]}"
    )
    forms = st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"])
    bodies = st.lists(elements | properties, max_size=20)
    for i, (form, body, rest) in enumerate(drawn(st.tuples(forms, bodies, st.binary(max_size=200)), count)):
        header = "\n".join(["ply", f"format {form} 1.0", *body, "end_header", ""])
        yield f"drawn {i}", header.encode() + rest
