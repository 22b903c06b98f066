"""The commands of protocol.py: every scene and split once, then the evaluation."""

from pathlib import Path

import pytest

import protocol
from querysplat_cli.scene.formats.dataset import CapturedScene, Frame

FRAMES = {"fox": 50, "dtu106": 20}
"""Others have eleven here, which fill the split of two near views alone."""


def test_a_repeated_run_makes_only_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[str, ...]] = []

    def fake(*arguments: str | Path) -> None:
        words = tuple(map(str, arguments))
        seen.append(words)
        out = Path(words[words.index("-o") + 1])
        if words[0] == "reconstruct":
            out.touch()
        elif "--splits-only" in words:
            (out / "splits").mkdir(parents=True)
            views, scale = (words[words.index(option) + 1] for option in ("--views", "--scales"))
            (out / "splits" / f"{views}views_{scale}.json").touch()

    def scenes(places: list[Path]) -> list[CapturedScene]:
        counts = {place.name: FRAMES.get(place.name, 11) for place in places}
        return [
            CapturedScene(name, tuple(Frame(i, f"{i}.png", "", Path(f"{i}.png")) for i in range(count)), {}, ())
            for name, count in counts.items()
        ]

    def cases() -> dict[tuple[str, str], int]:
        values = [{name: words[words.index(name) + 1] for name in ("--views", "--scales", "--cases")} for words in seen]
        return {(row["--views"], row["--scales"]): int(row["--cases"]) for row in values}

    monkeypatch.setattr(protocol, "querysplat", fake)
    monkeypatch.setattr(protocol, "find_scenes", scenes)
    places = protocol.scene_folders(protocol.SETS, tmp_path, tmp_path)
    assert [words[0] for words in seen] == ["reconstruct"] * (len(protocol.SETS) - 1)
    assert places[0] == tmp_path / "dl3dv" / "fox"
    seen.clear()
    protocol.write_splits(places, (2, 4, 12), tmp_path / "splits")
    shared = {("2", "small"): len(protocol.SETS), ("2", "medium"): 2, ("4", "small"): 2}
    expected = [(views, scale) for views in ("2", "4", "12") for scale in ("small", "medium", "large")]
    assert cases() == {each: 8 * shared.get(each, 1) for each in expected}
    assert len(list((tmp_path / "splits").iterdir())) == 9
    assert not list(tmp_path.glob("*views_*"))
    (tmp_path / "splits" / "12views_large.json").unlink()
    seen.clear()
    again = protocol.scene_folders(protocol.SETS, tmp_path, tmp_path)
    protocol.write_splits(again, (2, 4, 12), tmp_path / "splits")
    assert cases() == {("12", "large"): 8}
