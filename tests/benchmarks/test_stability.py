"""Every case of docs/stability.md holds on the machine of the tests, too."""

from dataclasses import replace

import pytest

import stability


def test_every_case_holds() -> None:
    rows = [stability.measure(case) for case in stability.cases()] + [stability.threads(), stability.poison()]
    assert len(rows) > 40
    assert [row for row in rows if not row.holds] == []


def test_a_wrong_picture_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of 1e-4 in every colour of the kernel fails a case."""
    exact = stability.render

    def darker(*arguments: object, backend: str, **options: object) -> object:
        found = exact(*arguments, backend=backend, **options)
        return replace(found, colour=found.colour + (1e-4 if backend == "cpu" else 0))

    monkeypatch.setattr(stability, "render", darker)
    case = next(case for case in stability.cases() if case.what.startswith("equal depths"))
    assert not stability.measure(case).holds
