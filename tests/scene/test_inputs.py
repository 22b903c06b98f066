"""Photos and films as they are given: in order, with clear names, and with one line for what is left out."""

from pathlib import Path

import cv2
import pytest

from film_files import pan, write_film
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.inputs import load_inputs
from querysplat_cli.scene.photos import find_photos, load_photos


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two photos, and a film of 25 frames between them."""
    for name, picture in zip(("a.png", "z.png"), pan([0, 500]), strict=True):
        cv2.imwrite(str(tmp_path / name), picture)
    write_film(tmp_path / "m.mp4", pan(range(0, 500, 20)))
    return tmp_path


def test_films_and_photos_of_a_folder(folder: Path) -> None:
    photos, left_out = load_inputs(find_photos([folder]), frames=6)
    names = [photo.name for photo in photos]
    assert names[0] == "a.png"
    assert names[-1] == "z.png"
    assert names == sorted(names)
    assert len(names) == 8
    assert all(photo.name.startswith("m.mp4_000") for photo in photos[1:-1])
    assert all((photo.pts is not None) == (photo.path.name == "m.mp4") for photo in photos)
    assert [(each.name, each.why) for each in left_out] == [("m.mp4", "19 of its 25 frames: 19 close to those used")]


def test_a_folder_of_films_alone(tmp_path: Path) -> None:
    for name in ("one.MOV", "two.mp4"):
        write_film(tmp_path / name, pan(range(0, 100, 20)))
    photos, left_out = load_inputs(find_photos([tmp_path]))
    assert [photo.name[:3] for photo in photos] == ["one"] * 5 + ["two"] * 5
    assert not left_out


def test_the_film_of_a_live_photo_is_left_out(folder: Path) -> None:
    write_film(folder / "A.MOV", pan([0, 40, 80]))
    write_film(folder / "other.MOV", pan([0, 40, 80]))
    photos, left_out = load_inputs(find_photos([folder]))
    assert not any(photo.name.startswith("A.MOV") for photo in photos)
    assert sum(photo.name.startswith("other.MOV") for photo in photos) == 3
    assert ("A.MOV", "it is the film of the Live Photo beside it") in [(each.name, each.why) for each in left_out]
    (folder / "m.mp4").unlink()
    (folder / "other.MOV").unlink()
    photos, left_out = load_inputs(find_photos([folder]))
    assert [photo.name for photo in photos] == ["a.png", "z.png"]
    assert [each.name for each in left_out] == ["A.MOV"]


@pytest.mark.parametrize("name", ["A.MP4", "a.mp4"])
def test_the_film_of_a_live_photo_may_be_an_mp4(folder: Path, name: str) -> None:
    write_film(folder / name, pan([0, 40, 80]))
    photos, left_out = load_inputs(find_photos([folder]))
    assert not any(photo.name.startswith(name) for photo in photos)
    assert (name, "it is the film of the Live Photo beside it") in [(each.name, each.why) for each in left_out]


def test_films_of_one_name(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_film(tmp_path / folder / "clip.mp4", pan([0, 40]))
    photos, _ = load_inputs(find_photos([tmp_path / "a", tmp_path / "b"]))
    assert [photo.name.split("_")[0] for photo in photos] == ["a/clip.mp4"] * 2 + ["b/clip.mp4"] * 2
    assert len({photo.name for photo in photos}) == 4


def test_a_broken_film_among_others_is_left_out(folder: Path) -> None:
    (folder / "broken.mp4").write_bytes(b"\0" * 100)
    (folder / "empty.webm").touch()
    photos, left_out = load_inputs(find_photos([folder]))
    assert len(photos) > 10
    assert [each.name for each in left_out][:2] == ["broken.mp4", "empty.webm"]
    assert "not a film that can be read" in left_out[0].why
    assert left_out[1].why == "the file is empty"


def test_broken_films_alone_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(QuerySplatError, match=r"empty\.mp4 \(the file is empty\)") as caught:
        load_inputs([tmp_path / "empty.mp4"])
    assert "MP4" in caught.value.hint


def test_one_frame_is_one_photo(tmp_path: Path) -> None:
    photos, left_out = load_inputs([write_film(tmp_path / "one.mp4", pan([0]))])
    assert [photo.name for photo in photos] == ["one.mp4_0000.000.jpg"]
    assert not left_out


def test_frames_without_a_film_are_refused(folder: Path) -> None:
    with pytest.raises(QuerySplatError, match="no film"):
        load_inputs([folder / "a.png"], frames=5)


def test_photos_alone_are_read_as_ever(folder: Path) -> None:
    paths = [folder / "z.png", folder / "a.png"]
    one, two = load_inputs(paths), load_photos(paths)
    assert [photo.name for photo in one[0]] == [photo.name for photo in two[0]]
    assert one[1] == two[1]
