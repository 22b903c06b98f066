"""Rows of a sweep over any field of the settings, checked by the field's type."""

from pathlib import Path

import pytest

from querysplat_cli.evaluation.axes import axes, read_axis
from querysplat_cli.evaluation.grid import rows
from querysplat_cli.runtime.errors import QuerySplatError


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        ("tto=0,20,auto", ("tto", (0, 20, None))),
        ("max-size=256, 512", ("max_size", (256, 512))),
        ("precision=fp32,bf16", ("precision", ("fp32", "bf16"))),
        ("tto_target=kv,features", ("tto_target", ("kv", "features"))),
        ("depth=true,false", ("depth", (True, False))),
        ("queries=500,auto,500", ("queries", (500, None))),
        ("preset=compact,mine/other.safetensors", ("preset", ("compact", "mine/other.safetensors"))),
    ],
)
def test_values_have_the_fields_type(text: str, axis: tuple[str, tuple[object, ...]]) -> None:
    assert read_axis(text) == axis


@pytest.mark.parametrize(
    "text", ["tto", "tto=", "tto=many", "tto=1.5", "force=true", "nonsense=1", "=1", "regions=1,4", "overlays=auto,off"]
)
def test_other_values_are_refused(text: str) -> None:
    with pytest.raises(QuerySplatError, match="--sweep"):
        read_axis(text)


@pytest.mark.parametrize("text", ["tto=-5,0", "max_size=20"])
def test_bounds_are_those_of_the_option(text: str) -> None:
    with pytest.raises(QuerySplatError, match="cannot be"):
        read_axis(text)


def test_every_setting_that_makes_a_scene_can_be_varied() -> None:
    assert {"tto", "queries", "max_size", "preset", "encoder"} <= axes().keys()
    assert not {"inputs", "ply", "force", "poses", "fit"} & axes().keys()


def test_rows_are_the_product() -> None:
    table = rows([read_axis("tto=0,5"), read_axis("preset=compact,a/b.safetensors")], ["free", "posed"])
    assert len(table) == 2 * (1 + 2 * 2)
    assert [row.name for row in table[:3]] == ["free_depth", "free_tto=0_preset=compact", "free_tto=0_preset=a-b"]
    assert table[2].overrides == (("tto", 0), ("preset", "a/b.safetensors"))
    assert len({row.name for row in table}) == len(table)
    assert all(Path(row.name).name == row.name for row in table)
    with pytest.raises(QuerySplatError, match="twice"):
        rows([read_axis("tto=0"), read_axis("tto=5")], ["free"])


def test_files_of_one_name_in_two_folders_have_rows_of_their_own() -> None:
    table = rows([read_axis("preset=a/model.safetensors,b/model.safetensors")], ["free"])
    assert [row.name for row in table[1:]] == ["free_preset=a-model", "free_preset=b-model"]
    with pytest.raises(QuerySplatError, match="two rows would be called free_preset=c-model"):
        rows([read_axis("preset=a/c/model.safetensors,b/c/model.safetensors")], ["free"])
