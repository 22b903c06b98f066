"""What an evaluation says of its size before it begins."""

import pytest

from querysplat_cli.evaluation.plan import Job
from querysplat_cli.evaluation.run import _count


@pytest.mark.parametrize(
    ("cases", "rows", "text"),
    [
        (3, 2, "3 cases of 5 splits, 6 scenes to make, 2 at a time"),
        (2700, 6, "2,700 cases of 5 splits, 16,200 scenes to make, 2 at a time; --cases N takes N cases of each split"),
    ],
)
def test_the_number_of_cases_is_said_and_how_to_make_fewer(cases: int, rows: int, text: str) -> None:
    job = object.__new__(Job)
    object.__setattr__(job, "rows", (None,) * rows)
    assert _count([job] * cases, 5, 2) == text
