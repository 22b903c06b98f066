"""How far our arithmetic is from the released one, unit by unit, on fixtures made by the latter.

    python benchmarks/parity.py [FOLDER] [--json]

FOLDER holds the fixtures; by default it is $QUERYSPLAT_GOLDEN. A fixture is NAME.json, which names its unit, sizes,
inputs and outputs, and NAME.safetensors, which holds them and the weights (`state.*`, official names). The error of a
tensor is max|a − b| / max|b|. A unit is reported with the tensor whose error is the largest share of its tolerance.
The exit code is 1 when a unit fails. Units that this program cannot run are listed as not covered.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import parity_encoders
import parity_model
from common.locations import FIXTURES, location
from golden import Fixture, Tensors, read_fixtures

import torch
from torch import Tensor

TOLERANCES = {
    "appearance_decoder": 2e-5,
    "pipeline": 1e-4,
    "ply_export": 1e-6,
    "querysplat": 3e-5,
    "ssim": 2e-5,
    "vggt_aggregator": 1e-4,
    "vggt_camera_head": 1e-4,
    "vggt_depth_head": 1e-4,
    "vggt_omega_aggregator": 2e-5,
    "vggt_omega_camera_head": 2e-5,
}
TOLERANCE = 1e-5
"""For the units that TOLERANCES does not name."""
LOOSER = {("ssim", "map_same"): 1e-4}
"""Single tensors with a tolerance of their own."""

WHOLE = parity_model.WHOLE | parity_encoders.UNITS


def run(fixture: Fixture) -> Tensors:
    """Our outputs for a fixture whose unit is covered."""
    if fixture.unit in WHOLE:
        return WHOLE[fixture.unit](fixture)
    model = fixture.model()
    rows = [parity_model.BY_SCENE[fixture.unit](fixture, model, scene) for scene in fixture.scenes()]
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def relative_error(ours: Tensor, theirs: Tensor) -> float:
    """max|a − b| / max|b|; infinite for another shape, and where ours is not finite."""
    if ours.shape != theirs.shape:
        return math.inf
    difference = (ours.double() - theirs.double()).abs().max() if theirs.numel() else torch.zeros(())
    size = theirs.double().abs().max() if theirs.numel() else torch.ones(())
    error = float(difference / size) if size > 0 else float(difference)
    return math.inf if math.isnan(error) else error


def compare(fixture: Fixture) -> dict[str, Any]:
    """The entry of one unit in the JSON object. Where no error can be computed it is null, and `why` is the reason."""
    tolerance = TOLERANCES.get(fixture.unit, TOLERANCE)
    try:
        ours = run(fixture)
        missing = sorted(fixture.outputs.keys() - ours.keys())
        if missing or not fixture.outputs:
            raise KeyError(f"nothing to compare with {', '.join(missing) or 'our outputs'}")
    except Exception as error:
        return {
            "max_relative_error": None,
            "tolerance": tolerance,
            "ok": False,
            "why": f"{type(error).__name__}: {error}",
        }
    rows = [
        (relative_error(ours[name].detach(), theirs), LOOSER.get((fixture.unit, name), tolerance), name)
        for name, theirs in fixture.outputs.items()
    ]
    error, allowed, name = max(rows, key=lambda row: row[0] / row[1])
    if math.isinf(error):
        return {"max_relative_error": None, "tolerance": allowed, "ok": False, "why": f"{name}: shape, or not finite"}
    return {"max_relative_error": error, "tolerance": allowed, "ok": error <= allowed}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=location(FIXTURES), help="default: $QUERYSPLAT_GOLDEN")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options = parser.parse_args(arguments)
    fixtures = read_fixtures(options.folder)
    if not fixtures:
        parser.error(f"no fixtures (NAME.json with NAME.safetensors) in {options.folder}")
    covered = parity_model.BY_SCENE.keys() | WHOLE.keys()
    units = {fixture.name: compare(fixture) for fixture in fixtures if fixture.unit in covered}
    not_covered = [fixture.name for fixture in fixtures if fixture.unit not in covered]
    if options.json:
        print(json.dumps({"units": units, "not_covered": not_covered}, indent=1))
    else:
        for name, row in units.items():
            error = row["why"] if row["max_relative_error"] is None else f"{row['max_relative_error']:.1e}"
            print(f"{'ok  ' if row['ok'] else 'FAIL'} {name:22} {error} (tolerance {row['tolerance']:.0e})")
        print(f"not covered: {', '.join(not_covered) or 'none'}")
    return 0 if all(row["ok"] for row in units.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
