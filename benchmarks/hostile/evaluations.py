"""Damaged results of `querysplat eval`, which are merged."""

import json
from collections.abc import Iterator

from hostile.case import QUIET, Case, several
from hostile.damage import changed_json, damaged
from hostile.sound import Sound
from querysplat_cli.evaluation.splits import GROUPS

SCORES = {"psnr": 20.4, "ssim": 0.7, "lpips": None}
ROW = "in/posed_tto=0/2views_small"
FILES = {
    "run_config.json": {
        "settings": {"method": "querysplat", "cameras": "posed", "tto": 0, "preset": "compact"},
        "protocol": "release",
        "split": {
            "name": "2views_small", "num_input_views": 2, "scale": "small", "total_samples": 1, "sha256": "0" * 64,
        },
        "lpips": {"missing": "no LPIPS"},
        "torch": "2.13.0",
        "querysplat": "0.1.0",
        "machine": "any",
    },
    "a_000/metrics.json": {
        "scene_id": "a",
        "frames": {group: [{"name": f"{group}.png", "frame_index": 1}] for group in GROUPS},
        "per_view": {group: [SCORES] for group in GROUPS},
        "mean": dict.fromkeys(GROUPS, SCORES),
        "missing": {group: {} for group in GROUPS},
        "apart": {group: [] for group in GROUPS},
        "doubts": [],
    },
    "a_000/timing.json": {
        "seconds": {"depth": 1.0, "total": 1.0}, "peak_memory_gib": 0.7, "gaussians": 22077, "machine": "any",
    },
    "b_001/failure.json": {
        "scene_id": "b", "error": "no overlap", "hint": "", "asked": {"input": 2}, "apart": {"input": ["a.png"]},
    },
}  # fmt: skip
"""A case with scores and one that failed, as `eval` writes them."""


def evaluations(sound: Sound) -> Iterator[Case]:
    """One of the files is damaged; `eval --merge` copies all of them or none."""
    merge = ("eval", "in", "--merge", "-o", "out", QUIET)
    whole = {f"{ROW}/{name}": json.dumps(content).encode() for name, content in FILES.items()}
    yield Case("results of eval", "sound", several(whole), merge, frozenset({0}))
    for name in whole:
        for what, content in (*changed_json(whole[name], name, 25), *damaged(whole[name], name, 4, 2)):
            yield Case("results of eval", f"{name[len(ROW) + 1 :]}: {what}", several({**whole, name: content}), merge)
