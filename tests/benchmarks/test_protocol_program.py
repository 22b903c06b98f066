"""The commands of protocol.py: every scene and split once, then the evaluation."""

from pathlib import Path

import pytest

import protocol


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

    monkeypatch.setattr(protocol, "querysplat", fake)
    scenes = protocol.scene_folders(tmp_path, tmp_path)
    protocol.write_splits(scenes, tmp_path / "splits")
    assert [words[0] for words in seen] == ["reconstruct"] * 4 + ["eval"] * 9
    assert len(list((tmp_path / "splits").iterdir())) == 9
    assert not list(tmp_path.glob("*views_*"))
    (tmp_path / "splits" / "12views_large.json").unlink()
    seen.clear()
    protocol.write_splits(protocol.scene_folders(tmp_path, tmp_path), tmp_path / "splits")
    assert [words[-7:-1] for words in seen] == [("large", "--cases", "8", "--splits-only", "-q", "-o")]
