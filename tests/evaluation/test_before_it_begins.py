"""What an evaluation says of its size before it begins, and of how far it is."""

from types import SimpleNamespace

import pytest

from querysplat_cli.evaluation.count import Counter, to_do
from querysplat_cli.evaluation.plan import Job


def job(rows: int, name: str = "case") -> Job:
    made = object.__new__(Job)
    for key, value in {"split": "s", "case": SimpleNamespace(name=name), "rows": (None,) * rows}.items():
        object.__setattr__(made, key, value)
    return made


@pytest.mark.parametrize(
    ("cases", "rows", "text"),
    [
        (1, 1, "1 case of 5 splits, 1 scene to make, 2 at a time"),
        (3, 2, "3 cases of 5 splits, 6 scenes to make, 2 at a time"),
        (2700, 6, "2,700 cases of 5 splits, 16,200 scenes to make, 2 at a time; --cases N takes N cases of each split"),
    ],
)
def test_the_number_of_cases_is_said_and_how_to_make_fewer(cases: int, rows: int, text: str) -> None:
    assert to_do([job(rows)] * cases, 5, 2) == text


def test_every_scene_is_counted_and_not_every_case() -> None:
    """A case of many rows showed nothing but seconds until its last row."""
    said: list[tuple[str, float]] = []
    first, second = job(4, "a"), job(1, "b")
    counter = Counter([first, second], lambda text, fraction: said.append((text, fraction)))
    counter.heard(first, "free", 0.0)
    counter.heard(first, "posed", 0.25)
    counter.done(second)
    counter.done(first)
    assert said == [
        ("0 of 5 scenes: s, a, free", 0.0),
        ("1 of 5 scenes: s, a, posed", 0.2),
        ("2 of 5 scenes: s, b", 0.4),
        ("5 of 5 scenes: s, a", 1.0),
    ]
