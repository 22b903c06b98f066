"""How text on the command line becomes the value of a setting, by the setting's type."""

from collections.abc import Callable, Iterable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import click
from annotated_types import Ge, Gt

from querysplat_cli.runtime.options import Option


class NumberOrWord(click.ParamType):
    """A number, or one of a few words that stand for a value each."""

    name = "number or word"

    def __init__(self, number: click.ParamType, words: dict[str, Any]) -> None:
        self.number, self.words = number, words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in self.words:
            return self.words[value]
        try:
            return self.number.convert(value, param, ctx)
        except click.BadParameter as error:
            raise click.BadParameter(f"{error.message} Or write {' or '.join(self.words)}.", ctx, param) from None


class CommaSeparated(click.ParamType):
    """Values between commas, each of them once, as a tuple."""

    name = "list"

    def __init__(self, item: click.ParamType) -> None:
        self.item = item

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        parts = value.split(",") if isinstance(value, str) else value
        return tuple(dict.fromkeys(self.item.convert(self._text(part), param, ctx) for part in parts))

    @staticmethod
    def _text(part: Any) -> Any:
        return part.strip() if isinstance(part, str) else part


class Parsed(click.ParamType):
    """Text in a form of its own, read by a function that raises QuerySplatError."""

    name = "text"

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self.parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self.parse(value) if isinstance(value, str) else value


def param_type(kind: Any, bounds: Iterable[object], option: Option) -> click.ParamType:
    """The click type of a setting of type `kind`; that of an item where the option is repeated."""
    if option.parse:
        return Parsed(option.parse)
    if get_origin(kind) is tuple:
        item = param_type(get_args(kind)[0], bounds, option)
        return item if option.repeated or option.argument else CommaSeparated(item)
    if get_origin(kind) in (Union, UnionType):
        return _union_type([part for part in get_args(kind) if part is not NoneType], bounds, option)
    simple = _simple_type(kind, bounds)
    return NumberOrWord(simple, {"auto": None}) if option.auto else simple


def _union_type(parts: list[Any], bounds: Iterable[object], option: Option) -> click.ParamType:
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    others = [part for part in parts if get_origin(part) is not Literal]
    if not others:
        return click.Choice(words)
    simple = _simple_type(others[0], bounds)
    if option.auto:
        return NumberOrWord(simple, {"auto": None})
    return NumberOrWord(simple, {word: word for word in words}) if words else simple


def _simple_type(kind: Any, bounds: Iterable[object]) -> click.ParamType:
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    if kind in (int, float):
        return _number_type(kind, bounds)
    return click.Path(path_type=Path) if kind is Path else click.STRING


def _number_type(kind: type[int] | type[float], bounds: Iterable[object]) -> click.ParamType:
    numbers = click.IntRange if kind is int else click.FloatRange
    for bound in bounds:
        if isinstance(bound, Ge):
            return numbers(min=bound.ge)  # type: ignore[arg-type]  # a number, as the field
        if isinstance(bound, Gt):
            return numbers(min=bound.gt, min_open=True)  # type: ignore[arg-type]
    return click.INT if kind is int else click.FLOAT
