"""The worked examples of docs/other-methods.md, run as they stand there on pictures in the layouts it describes."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest

from querysplat_cli.cli import run

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
from evaluation_scenes import write_room

PAGE = Path(__file__).resolve().parents[2] / "docs" / "other-methods.md"

SECTIONS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL))
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(system: str, language: str = "") -> list[str]:
    return [text for kind, text in BLOCK.findall(SECTIONS[system]) if kind == language]


def scored(command: str) -> dict[str, dict[str, Any]]:
    """The summary of the row that `command` writes, by group."""
    words = shlex.split(command)
    assert words[0] == "querysplat"
    assert run([*words[1:], "-o", "out", "-q"]) == 0
    summary = json.loads(Path("out/summary.json").read_text())
    assert summary["failures"] == []
    assert {row["row"] for row in summary["rows"]} == {words[words.index("--name") + 1]}
    return {
        row["group"]: {key: row[key] for key in ("scored", "asked")} | {"psnr": row["psnr"]} for row in summary["rows"]
    }


def save_darker(source: Path, file: Path) -> None:
    """A render that is a tenth darker than the photo."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), (cv2.imread(str(source)) * 0.9).round().astype("uint8"), [cv2.IMWRITE_JPEG_QUALITY, 100])


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("system", ["YoNoSplat", "SPFSplat"])
def test_pictures_by_frame_need_no_change(system: str) -> None:
    write_room(Path("DL3DV/room"), 5, size=96)
    Path("index.json").write_text(json.dumps({"room": {"context": [0, 3], "target": [1, 2, 4]}}))
    for frame in (1, 2, 4):
        photo = square(Path(f"DL3DV/room/images_4/frame_{frame + 1:05d}.png"))
        save_darker(photo, Path(f"outputs/test/{system.lower()}/room/color/{frame:06d}.png"))
    found = scored(blocks(system)[0])
    assert {group: (row["scored"], row["asked"]) for group, row in found.items()} == {
        "input": (0, 2),
        "interp": (2, 2),
        "extrap": (1, 1),
    }
    assert 20 < found["interp"]["psnr"] < 40


def test_splatweavers_own_choice_of_targets_is_scored() -> None:
    """The documented program writes the index file and the names; photos and pictures of another use are ignored."""
    write_room(Path("made"), 17, size=96)
    Path("photos").mkdir()
    Path("made/images_4").rename("photos/room")
    names = sorted(Path("photos/room").iterdir())
    scene = Path("outputs/splatweaver/room")
    for number, frame in enumerate((7, 15)):
        for kind in ("pred", "gt"):
            save_darker(square(names[frame]), scene / kind / f"{number:06d}.jpg")
    save_darker(names[0], scene / "expert_selection.png")
    exec(compile(blocks("SplatWeaver", "python")[0].replace("16  #", "4  #"), "docs", "exec"), {})
    assert json.loads(Path("index.json").read_text()) == {"room": {"context": [0, 5, 10, 16], "target": [7, 15]}}
    found = scored(blocks("SplatWeaver")[0])
    assert {group: (row["scored"], row["asked"]) for group, row in found.items()} == {"input": (0, 4), "interp": (2, 2)}
    assert 20 < found["interp"]["psnr"] < 40


def square(file: Path) -> Path:
    """A copy of a picture, cut to the centred square that `--protocol release` scores."""
    picture = cv2.imread(str(file))
    side = min(picture.shape[:2])
    top, left = ((size - side) // 2 for size in picture.shape[:2])
    copy = Path(f"square_{file.name}").absolute()
    cv2.imwrite(str(copy), picture[top : top + side, left : left + side])
    return copy
