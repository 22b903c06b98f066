"""Scenes in the layouts of public datasets, and the faults that these have in practice."""

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.colmap import write_colmap
from querysplat_cli.scene.formats.dataset import ZipMember, fetch, find_scenes

FRAMES = 5


def write_pictures(folder: Path, numbers: list[int]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        cv2.imwrite(str(folder / f"frame_{number:05d}.png"), np.full((48, 64, 3), number, np.uint8))


def listing(numbers: list[int], **changes: Any) -> dict[str, Any]:
    """A transforms.json of full-size pictures, camera i at (i, 0, 0)."""
    frames = []
    for number in numbers:
        matrix = np.eye(4)
        matrix[0, 3] = number
        frames.append({"file_path": f"images/frame_{number:05d}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240, "k1": 0.01}
    return {**lens, "camera_model": "OPENCV", "frames": frames, **changes}


def write_scene(home: Path, folder: str = "images_4", **changes: Any) -> None:
    numbers = list(range(1, FRAMES + 1))
    write_pictures(home / folder, numbers)
    (home / "transforms.json").write_text(json.dumps(listing(numbers, **changes)))


@pytest.mark.parametrize("inner", ["", "nerfstudio", "colmap"])
def test_layouts_of_dl3dv(tmp_path: Path, inner: str) -> None:
    """10K, Benchmark and sample; the subset's folder lies between the root and the scenes."""
    for name in ("b2", "b10"):
        write_scene(tmp_path / "1K" / name / inner)
    scenes = find_scenes([tmp_path])
    assert [scene.name for scene in scenes] == ["b2", "b10"]
    for scene in scenes:
        assert [frame.index for frame in scene.frames] == list(range(FRAMES))
        assert scene.cameras["frame_00003.png"].w2c[0, 3] == -3
        assert scene.notes == ()
    assert find_scenes([tmp_path / "1K" / "b2"])[0].name == "b2"


def test_a_listing_without_sizes_takes_those_of_its_pictures(tmp_path: Path) -> None:
    write_scene(tmp_path / "abc", "images")
    content = listing(list(range(1, FRAMES + 1)))
    del content["w"], content["h"]
    (tmp_path / "abc" / "transforms.json").write_text(json.dumps(content))
    packed = Path(shutil.make_archive(str(tmp_path / "archive"), "zip", tmp_path / "abc"))
    for place in (tmp_path / "abc", packed):
        (scene,) = find_scenes([place])
        assert {(camera.width, camera.height) for camera in scene.cameras.values()} == {(64, 48)}


def test_a_zip_is_read_like_its_folder(tmp_path: Path) -> None:
    write_scene(tmp_path / "abc" / "scene1")
    packed = Path(shutil.make_archive(str(tmp_path / "archive"), "zip", tmp_path / "abc"))
    plain, zipped = find_scenes([tmp_path / "abc"])[0], find_scenes([packed])[0]
    assert zipped.name == plain.name == "scene1"
    assert [(frame.index, frame.name, frame.folder) for frame in zipped.frames] == [
        (frame.index, frame.name, frame.folder) for frame in plain.frames
    ]
    assert zipped.cameras.keys() == plain.cameras.keys()
    assert all(isinstance(frame.file, ZipMember) for frame in zipped.frames)
    copies = fetch(zipped.frames[1:3], tmp_path / "scratch")
    for copy, original in zip(copies, fetch(plain.frames[1:3], tmp_path), strict=True):
        assert copy.name == original.name
        assert copy.read_bytes() == original.read_bytes()


def test_pictures_that_are_listed_without_suffixes(tmp_path: Path) -> None:
    """As in NeRF's synthetic scenes; also in a zip, whose copies have the suffix of the file."""
    frames = [{**frame, "file_path": frame["file_path"].removesuffix(".png")} for frame in listing([1, 2])["frames"]]
    write_scene(tmp_path / "abc" / "scene1", "images", frames=frames)
    packed = Path(shutil.make_archive(str(tmp_path / "archive"), "zip", tmp_path / "abc"))
    for place in (tmp_path / "abc", packed):
        (scene,) = find_scenes([place], "images")
        assert [frame.name for frame in scene.frames] == list(scene.cameras) == ["frame_00001", "frame_00002"]
        assert scene.notes == ()
        assert [file.name for file in fetch(scene.frames, tmp_path)] == ["frame_00001.png", "frame_00002.png"]


@pytest.mark.parametrize("home", [".", "gaussian_splat"])
@pytest.mark.parametrize("text", [False, True])
def test_a_colmap_project(tmp_path: Path, home: str, text: bool) -> None:
    """The layout of COLMAP projects and of DL3DV's Benchmark, as a folder or a zip."""
    write_scene(tmp_path / "dl3dv")
    (known,) = find_scenes([tmp_path / "dl3dv"])
    model = tmp_path / "in" / "scene1" / home / "sparse" / "0"
    write_pictures(tmp_path / "in" / "scene1" / home / "images_4", list(range(1, FRAMES + 1)))
    model.mkdir(parents=True)
    write_colmap(model, known.cameras, text=text)
    packed = Path(shutil.make_archive(str(tmp_path / "archive"), "zip", tmp_path / "in"))
    for place in (tmp_path / "in", packed):
        (scene,) = find_scenes([place])
        assert [frame.name for frame in scene.frames] == list(scene.cameras) == list(known.cameras)
        assert scene.cameras["frame_00003.png"].w2c == pytest.approx(known.cameras["frame_00003.png"].w2c)
        assert scene.cameras["frame_00003.png"].distortion[0] == pytest.approx(0.01)
        assert scene.notes == ()
    (tmp_path / "in" / "scene1" / home / "cameras.json").write_text("[]")  # as the original 3DGS writes it
    assert find_scenes([tmp_path / "in"])[0].cameras.keys() == known.cameras.keys()


def test_a_colmap_project_with_folders_of_pictures(tmp_path: Path) -> None:
    write_scene(tmp_path / "dl3dv")
    (known,) = find_scenes([tmp_path / "dl3dv"])
    home, cameras = tmp_path / "in" / "scene1", list(known.cameras.values())
    names = ("cam1/frame_00001.png", "cam1/frame_00002.png", "cam2/frame_00002.png")
    (home / "sparse" / "0").mkdir(parents=True)
    write_colmap(home / "sparse" / "0", dict(zip(names, cameras, strict=False)))
    write_pictures(home / "images" / "cam1", [1, 2])
    write_pictures(home / "images" / "cam2", [2])
    packed = Path(shutil.make_archive(str(tmp_path / "archive"), "zip", tmp_path / "in"))
    for place in (tmp_path / "in", packed):
        (scene,) = find_scenes([place], "images")
        assert [frame.name for frame in scene.frames] == ["frame_00001.png", *names[1:]]
        assert scene.notes == ()


def test_a_damaged_listing_is_named(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene1")
    (tmp_path / "scene1" / "transforms.json").write_text("{")
    with pytest.raises(QuerySplatError, match=r"transforms\.json"):
        find_scenes([tmp_path])


def test_one_scene_that_cannot_be_read_leaves_the_others(tmp_path: Path) -> None:
    """A cut off listing, and a zip whose download broke off, stopped the evaluation of a whole folder."""
    write_scene(tmp_path / "good")
    write_scene(tmp_path / "cut")
    (tmp_path / "cut" / "transforms.json").write_text("{")
    (tmp_path / "torn.zip").write_bytes(b"PK\3\4")
    cut, good, torn = find_scenes([tmp_path])
    assert (len(good.frames), good.fault) == (FRAMES, "")
    for scene, reason in ((cut, "transforms.json"), (torn, "no zip")):
        assert not scene.frames
        assert reason in scene.fault
        assert scene.notes == (f"left out: {scene.fault}",)


def test_a_zip_made_on_a_mac(tmp_path: Path) -> None:
    """Its second folder of the same name, with notes of macOS, counted as a second scene."""
    write_scene(tmp_path / "abc" / "scene1")
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archive:
        for file in (tmp_path / "abc").rglob("*.*"):
            place = file.relative_to(tmp_path / "abc")
            archive.write(file, place)
            archive.writestr(f"__MACOSX/{place.parent.as_posix()}/._{place.name}", b"notes")
    (scene,) = find_scenes([tmp_path / "archive.zip"])
    assert len(scene.frames) == FRAMES


def test_a_damaged_member_of_a_zip_is_named(tmp_path: Path) -> None:
    """It ended in a traceback, or was listed as a bug."""
    write_scene(tmp_path / "abc" / "scene1")
    packed = tmp_path / "archive.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for file in (tmp_path / "abc").rglob("*.*"):
            archive.write(file, file.relative_to(tmp_path / "abc"))
    whole = packed.read_bytes()
    (scene,) = find_scenes([packed])
    packed.write_bytes(whole.replace(b"IDAT", b"JDAT"))
    with pytest.raises(QuerySplatError, match=r"archive\.zip.*cannot be unpacked"):
        fetch(scene.frames, tmp_path / "scratch")
    packed.write_bytes(whole.replace(b'"frames"', b'"grames"'))
    with pytest.raises(QuerySplatError, match=r"transforms\.json.*cannot be unpacked"):
        find_scenes([packed])


def test_our_scene_folder_with_its_held_out_photos(tmp_path: Path) -> None:
    numbers = list(range(1, FRAMES + 1))
    write_pictures(tmp_path / "scene" / "images", numbers)
    content = listing(numbers)
    content["heldout_frames"] = [content["frames"].pop(1)]
    (tmp_path / "scene" / "cameras.json").write_text(json.dumps(content))
    (scene,) = find_scenes([tmp_path / "scene"])
    assert [frame.name for frame in scene.frames] == [f"frame_{i:05d}.png" for i in numbers]
    assert scene.cameras["frame_00002.png"].w2c[0, 3] == -2
    assert len(scene.cameras) == FRAMES


def test_a_zip_cannot_write_outside(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        picture = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
        archive.writestr("scene/images_4/a.png", picture)
        archive.writestr("scene/images_4/../../../b.png", picture)
    for scene in find_scenes([tmp_path / "evil.zip"]):
        for file in fetch(scene.frames, tmp_path / "in" / "scratch"):
            assert (tmp_path / "in" / "scratch") in file.resolve().parents
    assert not (tmp_path / "b.png").exists()


def test_the_folder_is_replaced_by_name_only(tmp_path: Path) -> None:
    """A parent folder may be called images, too (AnySplat's loader renames that as well)."""
    write_scene(tmp_path / "images" / "scene1", "images_8")
    (scene,) = find_scenes([tmp_path / "images" / "scene1"])
    assert len(scene.frames) == FRAMES
    assert scene.frames[0].folder == "images_8"
    assert scene.notes == ("no images_4: its pictures are those of images_8",)


def test_frames_that_are_not_on_disk_keep_the_numbers_of_the_others(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene1")
    (tmp_path / "scene1" / "images_4" / "frame_00002.png").unlink()
    (scene,) = find_scenes([tmp_path])
    assert [frame.index for frame in scene.frames] == [0, 2, 3, 4]
    assert scene.notes == ("1 of 5 listed frames are not on disk",)


def test_a_picture_that_is_listed_twice_is_one_frame(tmp_path: Path) -> None:
    """The list of its paths was longer than that of the cameras, which ended in a traceback."""
    write_scene(tmp_path / "scene1", "images")
    (tmp_path / "scene1" / "transforms.json").write_text(json.dumps(listing([1, 2, 2, 3])))
    scene = find_scenes([tmp_path])[0]
    assert [Path(frame.name).name for frame in scene.frames] == [f"frame_{n:05d}.png" for n in (1, 2, 3)]
    assert {frame.name for frame in scene.frames} == set(scene.cameras)


def test_frames_are_in_natural_order_whatever_the_list_says(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene1")
    order = [3, 1, 5, 2, 4]
    (tmp_path / "scene1" / "transforms.json").write_text(json.dumps(listing(order)))
    (scene,) = find_scenes([tmp_path])
    assert [frame.name for frame in scene.frames] == [f"frame_{i:05d}.png" for i in range(1, 6)]
    assert [frame.index for frame in scene.frames] == [order.index(i) for i in range(1, 6)]


def test_cameras_that_are_not_rigid_are_left_out(tmp_path: Path) -> None:
    """NaN and mirrored cameras occur in DL3DV (DepthSplat's loader skips them)."""
    numbers = list(range(1, FRAMES + 1))
    content = listing(numbers)
    content["frames"][1]["transform_matrix"][0][0] = float("nan")
    content["frames"][2]["transform_matrix"][0][0] = -1.0
    write_pictures(tmp_path / "scene1" / "images_4", numbers)
    (tmp_path / "scene1" / "transforms.json").write_text(json.dumps(content))
    (scene,) = find_scenes([tmp_path])
    assert len(scene.frames) == FRAMES
    assert scene.cameras.keys() == {"frame_00001.png", "frame_00004.png", "frame_00005.png"}
    assert scene.notes == ("2 cameras are no rigid motions, and not used",)


def test_plain_photos_have_no_cameras(tmp_path: Path) -> None:
    write_pictures(tmp_path / "holiday", [10, 9, 2])
    (tmp_path / "holiday" / "notes.txt").write_text("no picture")
    (scene,) = find_scenes([tmp_path])
    assert (scene.name, scene.cameras) == ("holiday", {})
    assert [frame.index for frame in scene.frames] == [0, 1, 2]


def test_places_without_a_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="no such file"):
        find_scenes([tmp_path / "nowhere"])
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(QuerySplatError, match="no zip"):
        find_scenes([tmp_path / "text.zip"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(QuerySplatError, match="no scene in it"):
        find_scenes([tmp_path / "empty"])
    write_scene(tmp_path / "one" / "same")
    with pytest.raises(QuerySplatError, match="two scenes are called same"):
        find_scenes([tmp_path / "one", tmp_path / "one" / "same"])


def test_scenes_of_one_name_get_their_parents_names(tmp_path: Path) -> None:
    for parent in ("a", "b"):
        write_scene(tmp_path / parent / "nerfstudio")
        write_scene(tmp_path / parent / "rooms" / "hall")
    inner, halls = ([tmp_path / parent / part for parent in ("a", "b")] for part in ("nerfstudio", "rooms"))
    assert [scene.name for scene in find_scenes(inner)] == ["a", "b"]
    assert [scene.name for scene in find_scenes(halls)] == ["a_rooms_hall", "b_rooms_hall"]
    assert [scene.name for scene in find_scenes(halls[:1])] == ["hall"]
    assert [scene.name for scene in find_scenes(inner[:1])] == ["nerfstudio"]
    packed = [
        Path(shutil.make_archive(str(tmp_path / parent / "packed"), "zip", tmp_path / parent / "rooms"))
        for parent in ("a", "b")
    ]
    assert [scene.name for scene in find_scenes(packed)] == ["a_packed_hall", "b_packed_hall"]
    with pytest.raises(QuerySplatError, match="two scenes are called a"):
        find_scenes([inner[0], *inner])
