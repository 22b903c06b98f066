"""The worked examples of docs/other-methods.md, run as they stand there on outputs in the layouts it describes.

The outputs are made up here. Commands, programs and files of names are those of the page.
"""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from querysplat_cli.cli import run
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.transform import transform_gaussians
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

sys.path.insert(0, str(Path(__file__).parents[1] / "evaluation"))
from evaluation_scenes import write_room

PAGE = Path(__file__).resolve().parents[2] / "docs" / "other-methods.md"

SECTIONS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL))
FRAMES, SEED, WIDTH = 20, 3, 96
"""Photos of the room that stands in for the data set, the room's seed, and the photos' width in pixels."""
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


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("data") / "room"
    write_room(home, FRAMES, seed=SEED, size=WIDTH)
    return home


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the data set that the commands name, of one scene."""
    monkeypatch.chdir(tmp_path)
    Path("DL3DV").mkdir()
    Path("DL3DV/room").symlink_to(room)


def write_index(**scenes: dict[str, list[int]]) -> None:
    Path("index.json").write_text(json.dumps(scenes))


def photo(frame: int) -> Path:
    """What `--protocol release` scores of a photo."""
    return square(Path(f"DL3DV/room/images_4/frame_{frame + 1:05d}.png"))


def found_groups(found: dict[str, dict[str, Any]]) -> dict[str, tuple[int, int]]:
    return {group: (row["scored"], row["asked"]) for group, row in found.items()}


def test_every_system_of_the_table_has_a_command() -> None:
    table = re.findall(r"^\| (\w+) \|", PAGE.read_text(), re.MULTILINE)[1:]
    assert len(table) == 7
    assert set(table) == set(SECTIONS)
    assert all(len(blocks(system)) == 1 for system in table)


@pytest.mark.parametrize(
    ("system", "folder", "of_targets", "of_inputs"),
    [
        ("DepthSplat", "outputs/depthsplat/images/room", "color/{:06d}_gt.png", None),
        ("NoPoSplat", "outputs/test/noposplat/room", None, "context/{:06d}.png"),
        ("YoNoSplat", "outputs/test/yonosplat/room", None, "context/{:06d}.png"),
        ("SPFSplat", "outputs/test/spfsplat/room", None, None),
    ],
)
def test_pictures_by_frame_need_no_change(
    system: str, folder: str, of_targets: str | None, of_inputs: str | None
) -> None:
    """Photos that the system writes beside its renders are never scored."""
    write_index(room={"context": [0, 3], "target": [1, 2, 4]})
    for frame in (1, 2, 4):
        save_darker(photo(frame), Path(folder, f"color/{frame:06d}.png"))
    for frames, name in (((1, 2, 4), of_targets), ((0, 3), of_inputs)):
        for frame in frames if name else ():
            file = Path(folder, str(name).format(frame))
            file.parent.mkdir(exist_ok=True)
            photo(frame).rename(file)
    (command,) = blocks(system)
    found = scored(command)
    assert found_groups(found) == {"input": (0, 2), "interp": (2, 2), "extrap": (1, 1)}
    assert 20 < found["interp"]["psnr"] < 40


def test_anysplats_pictures_are_named_by_a_file() -> None:
    """The documented views.json, as it stands."""
    write_index(room={"context": [10, 13], "target": [11, 19]})
    case = Path("outputs/nvs/room")
    for number, frame in enumerate((11, 19)):
        save_darker(photo(frame), case / f"pred/{number:06d}.jpg")
        save_darker(photo(frame), case / f"gt/{number:06d}.jpg")
    (listed,), (command,) = blocks("AnySplat", "json"), blocks("AnySplat")
    (case / "views.json").write_text(listed)
    found = scored(command)
    assert found_groups(found) == {"input": (0, 2), "interp": (1, 1), "extrap": (1, 1)}
    assert 20 < found["interp"]["psnr"] < 40


def test_splatweavers_own_choice_of_targets_is_scored(room: Path) -> None:
    """The documented program writes the index file and the names; photos and pictures of another use are ignored."""
    Path("photos").mkdir()
    Path("photos/room").symlink_to(room / "images_4")
    scene = Path("outputs/splatweaver/room")
    for number, frame in enumerate((7, 15)):
        for kind in ("pred", "gt"):
            save_darker(photo(frame), scene / kind / f"{number:06d}.jpg")
    save_darker(photo(0), scene / "expert_selection.png")
    (program,), (command,) = blocks("SplatWeaver", "python"), blocks("SplatWeaver")
    exec(compile(program.replace("16  #", "4  #"), "docs", "exec"), {})
    assert json.loads(Path("index.json").read_text()) == {"room": {"context": [0, 6, 12, 19], "target": [7, 15]}}
    found = scored(command)
    assert found_groups(found) == {"input": (0, 4), "interp": (2, 2)}
    assert 20 < found["interp"]["psnr"] < 40


@pytest.mark.parametrize("preset", ["first camera", "mean camera"])
def test_tokengs_scenes_are_scored_in_their_own_frame(preset: str, room: Path) -> None:
    """Two scenes of the inputs' own pixels. The documented program finds each one's cameras and its .ply."""
    cases = {"late": [9, 6], "early": [0, 3]}
    Path("DL3DV/room").unlink()
    Path("results/gaussians").mkdir(parents=True)
    for number, (name, inputs) in enumerate(cases.items()):
        Path("DL3DV", name).mkdir()
        Path("DL3DV", name, "gaussian_splat").symlink_to(room)
        gaussians, cameras = seen(inputs)
        frame = tokengs_frame(cameras, mean=preset == "mean camera")
        write_ply(Path(f"results/gaussians/gaussians_0-0-{number}.ply"), transform_gaussians(gaussians, frame))
    write_index(late={"context": cases["late"], "target": [7]}, early={"context": cases["early"], "target": [1, 2]})
    program, function = blocks("TokenGS", "python")
    if preset == "mean camera":
        program = f"{function}\n{program.replace('poses[0]', 'middle(poses)')}"
    exec(compile(program, "docs", "exec"), {})
    (listing,), (command,) = blocks("TokenGS", "text"), blocks("TokenGS")
    assert all(Path(line.replace("<scene>", "late")).is_file() for line in listing.splitlines())
    found = scored(command)
    assert found_groups(found) == {"input": (4, 4), "interp": (3, 3)}
    # In another frame, or at another scale, the inputs have at most 17 dB.
    assert found["input"]["psnr"] > 22
    assert found["interp"]["psnr"] > 21


def seen(frames: list[int]) -> tuple[Gaussians, Cameras]:
    """A Gaussian for each pixel of these photos of the room, and their cameras, both in the data set's frame."""
    scene = make_room(SEED)
    cameras = walk(scene, FRAMES, SEED)
    cameras = cameras.resized(round(cameras.height * WIDTH / cameras.width), WIDTH)[frames]
    images, depth = cast(scene, cameras, samples=1)
    sizes = ((cameras.height, cameras.width),) * len(frames)
    masks = torch.ones(len(frames), *sizes[0], dtype=torch.bool)
    return back_project(Views(images, masks, tuple(map(str, frames)), sizes), cameras, depth, stride=1), cameras


def tokengs_frame(cameras: Cameras, mean: bool) -> Sim3:
    """From the data set's frame to that of the first camera or of the mean one, 0.15 times as large."""
    c2w = cameras.w2c.double().inverse()
    if not mean:
        axes, centre = c2w[0, :3, :3], c2w[0, :3, 3]
    else:
        forward = torch.nn.functional.normalize(c2w[:, :3, 2].mean(0), dim=0)
        down = c2w[:, :3, 1].mean(0)
        down = torch.nn.functional.normalize(down - (down @ forward) * forward, dim=0)
        axes = torch.stack([torch.linalg.cross(down, forward), down, forward], dim=1)
        centre = c2w[:, :3, 3].mean(0)
    return Sim3(0.15, axes.T, -0.15 * axes.T @ centre)


def square(file: Path) -> Path:
    """A copy of a picture, cut to the centred square that `--protocol release` scores."""
    picture = cv2.imread(str(file))
    side = min(picture.shape[:2])
    top, left = ((size - side) // 2 for size in picture.shape[:2])
    copy = Path(f"square_{file.name}").absolute()
    cv2.imwrite(str(copy), picture[top : top + side, left : left + side])
    return copy
