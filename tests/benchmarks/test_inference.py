"""The parts of the efficiency and precision programs that take no hours: tables, random weights, errors."""

import pytest
import torch

import full_size
import inference
import precision
from querysplat_cli.encoders.vggt_omega.model import VggtOmega
from tiny_weights import OMEGA


def test_tables_say_what_was_measured_and_no_more() -> None:
    rows = [
        {
            "views": 4,
            "precision": "bf16",
            "part": "both",
            "runs": 5,
            "encoder": 0.2,
            "decoder_8192": 0.5,
            "total": 0.7,
            "peak_gib": 5,
        },
        {"views": 7, "precision": "fp32", "part": "decoder", "error": "killed"},
    ]
    head, _, first, second = inference.table(rows).splitlines()
    assert head.count("|") == first.count("|") == second.count("|")
    assert "0.2 (paper 0.242)" in first
    assert "0.7 (paper 0.949)" in first
    assert "killed" in second
    assert "paper" not in second
    assert "| both | 5 |" in first


@pytest.mark.parametrize(("runs", "called", "mean"), [(5, 6, 4.0), (2, 3, 2.5), (1, 1, 1.0)])
def test_seconds_are_the_mean_of_the_runs_after_the_first(
    runs: int, called: int, mean: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run n takes n seconds. Only a single run is counted although it is the first."""
    clock, work = [0.0], iter(range(1, 100))

    def one_run() -> None:
        clock[0] += next(work)

    monkeypatch.setattr(inference.time, "perf_counter", lambda: clock[0])
    assert inference.mean_seconds(one_run, torch.device("cpu"), runs) == mean
    assert next(work) == called + 1


def test_a_row_says_how_many_runs_its_seconds_are_the_mean_of(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def mean_seconds(work: object, device: torch.device, runs: int) -> float:
        asked.append(runs)
        return 2.0

    monkeypatch.setattr(inference, "mean_seconds", mean_seconds)
    monkeypatch.setattr(inference.full_size, "querysplat", lambda *_: torch.nn.Identity())
    monkeypatch.setattr(torch.nn.Identity, "keep_queries", lambda self, count: None, raising=False)
    row = inference.measure(1, [1024, 8192], "fp32", torch.device("cpu"), "decoder", 5)
    assert asked == [5, 5]
    assert (row["runs"], row["decoder_1024"], row["decoder_8192"]) == (5, 2.0, 2.0)


def test_random_weights_have_the_types_of_their_precision() -> None:
    made = full_size.randomised(lambda: VggtOmega(OMEGA), "bf16", torch.device("cpu"))
    state = made.state_dict()
    assert state["aggregator.frame_blocks.0.mlp.fc1.weight"].dtype == torch.bfloat16
    assert state["aggregator.frame_blocks.0.norm1.weight"].dtype == torch.float32
    assert state["camera_head.trunk.0.mlp.fc1.weight"].dtype == torch.float32
    assert not any(tensor.is_meta for tensor in state.values())
    found = made.predict(full_size.photos(2, 64, torch.device("cpu")), depth=False)
    assert all(layer.isfinite().all() for layer in found.features)


def test_errors_of_known_differences() -> None:
    exact = {
        "features": torch.ones(2, 3),
        "w2c": torch.eye(4)[None],
        "centres": torch.randn(50, 3, generator=torch.Generator().manual_seed(0)),
        "scales": torch.ones(50, 3),
        "opacities": torch.full((50,), 0.5),
        "sh": torch.zeros(50, 4, 3),
        "picture": torch.full((1, 3, 4, 4), 0.5),
        "cost": torch.tensor([1.0, 2.0, 3.0]),
    }
    same = precision.compared("fp32", exact, exact)
    assert same["picture_psnr"] is None
    assert same["features"] == same["centres_median"] == 0
    rough = precision.compared(
        "bf16", {**exact, "scales": 1.25 * exact["scales"], "picture": exact["picture"] + 0.1}, exact
    )
    assert rough["scales_median"] == 0.25
    assert abs(rough["picture_psnr"] - 20) < 1e-4
    assert "20" in precision.table([same, rough]).splitlines()[-1]


def test_the_papers_efficiency_table_is_there() -> None:
    table = inference.efficiency()
    assert list(table) == [1, 2, 3, 4, 5, 6, 8, 12, 24, 48, 72, 100, 200, 300]
    assert table[300]["total_8192_seconds"] == 255.725
    for row in table.values():
        parts = row["encoder_seconds"] + row["decoder_8192_seconds"]
        assert row["total_8192_seconds"] == pytest.approx(parts, rel=0.01)
