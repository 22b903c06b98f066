"""The ablations' table and figure, from logs and scores written here."""

import json
from pathlib import Path

import pytest

import ablations


def log(folder: Path, psnr: float) -> Path:
    folder.mkdir()
    rows = [{"step": 10 * i, "pictures": 0.3 / i, "psnr": psnr, "seconds_per_step": 3.0} for i in range(1, 41)]
    rows[7] = {"step": 80, "psnr": None, "seconds_per_step": 3.0}  # every sample of these steps was skipped
    (folder / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def score(group: str, scene: str, model: str, psnr: float) -> dict[str, object]:
    return {"group": group, "set": scene, "row": f"{model}.safetensors", "steps": 0, "psnr": psnr, "ssim": 0.5}


def test_variants_are_compared_scene_by_scene_beside_the_paper(tmp_path: Path) -> None:
    names = ("small", "small-seed-1", "small-one-branch", "small-vggt", "small-other")
    runs = [ablations.read_run(log(tmp_path / name, 15.0 + i)) for i, name in enumerate(names)]
    scores = [
        score("made up", f"made up {scene}", name, 20.0 + scene + shift)
        for scene, spread in ((0, 0.1), (1, -0.1))
        for name, shift in (("small", 0.2), ("small-seed-1", -0.2), ("small-one-branch", spread - 1))
    ]
    scores.append(score("real", "fox", "small-one-branch", 13.0))
    lines = ablations.table(runs, scores).splitlines()
    assert lines[2] == "| small | 2 | 400 | 20.0 | 20.50 / 0.500 |  |  | 22.8963 / 0.7381 / 0.2682 |"
    one_branch = "| small-one-branch | 1 | 400 | 20.0 | 19.50 / 0.500 | -1.00 ± 0.10 | 13.00 / 0.500 | "
    assert lines[3] == one_branch + "20.9161 / 0.6593 / 0.344 |"
    assert lines[4].endswith("| 23.0723 / 0.7388 / 0.2749 |")
    assert lines[5].endswith("|  |  |  |  |")
    ablations.draw(tmp_path / "curves.png", runs)
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_a_folder_without_a_log_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"no log\.jsonl"):
        ablations.read_run(tmp_path)
