"""Stages of a command, and stages within one of them."""

from querysplat_cli.runtime.progress import stages_within


def test_stages_within_a_stage_are_its_progress() -> None:
    said: list[tuple[str, float]] = []
    stages = stages_within(lambda text, fraction: said.append((text, fraction)), {"depth": 1.0, "tto": 3.0})
    for name, text in (("depth", ""), ("another", "1 of 2"), ("tto", "7 of 9")):
        with stages(name) as progress:
            if text:
                progress(text, 0.5)
    assert said == [("depth", 0.0), ("depth", 0.25), ("tto", 0.25), ("tto 7 of 9", 0.625), ("tto", 1.0)]
