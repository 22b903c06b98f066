"""Pictures that are asked for when the cases are done already."""

from pathlib import Path

import pytest
from evaluation_scenes import write_room
from made_results import result

from querysplat_cli.evaluation.keeping import Keeping
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.evaluation.results import RowFolder, write_case
from querysplat_cli.evaluation.run import evaluate
from querysplat_cli.runtime.progress import Stages


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("data") / "room"
    write_room(home, 12, size=64)
    return home


@pytest.mark.parametrize(
    ("asked", "there", "said"),
    [
        ({"save_pictures": True}, "", True),
        ({"nerfbaselines": True}, "rendered", True),
        ({"save_pictures": True}, "rendered", False),
        ({}, "", False),
    ],
)
def test_finished_cases_without_the_pictures_asked_for_are_named(
    asked: dict[str, bool], there: str, said: bool, room: Path, tmp_path: Path
) -> None:
    (tmp_path / "theirs").mkdir()
    out = tmp_path / "out"
    write_case(out / "theirs" / "2views_small" / "room_000", "room", result(20.0))
    if there:
        (out / "theirs" / "2views_small" / "room_000" / there).mkdir()
    notes: list[str] = []
    request = EvalRequest(
        (room,), out, views=(2,), scales=("small",), cases=1, predictions=tmp_path / "theirs", **asked
    )
    evaluate(request, Stages(), notes.append)
    assert ("1 finished scene without the pictures asked for: only --force makes them again" in notes) is said


def test_no_folder_is_listed_where_no_pictures_are_asked_for(tmp_path: Path) -> None:
    nowhere = RowFolder(tmp_path / "missing", "theirs", "2views_small")
    assert Keeping().lacking([nowhere]) == 0
    with pytest.raises(FileNotFoundError):
        Keeping(rendered=True).lacking([nowhere])
