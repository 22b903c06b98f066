"""The entries of a report as JSON."""

import json
from pathlib import Path

from querysplat_cli.reporting.report import settings_entry


def test_settings_keep_their_types_in_json() -> None:
    settings = {"inputs": (Path("a"), Path("b")), "budget": 2.5, "force": True, "tto": None, "weights": Path("w")}
    written = json.loads(json.dumps(settings_entry(settings)))
    assert written == {"inputs": ["a", "b"], "budget": 2.5, "force": True, "tto": None, "weights": "w"}
