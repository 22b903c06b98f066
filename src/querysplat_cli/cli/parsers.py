"""How text on the command line becomes the value of a setting, by the setting's type."""

from collections.abc import Callable, Iterable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import typer
from annotated_types import Ge, Gt, Le

from querysplat_cli.runtime.current_folder import is_unicode
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.options import Option

LARGEST = 2**31 - 1
"""The largest whole number of an option: COLMAP's seeds are no larger, and nothing here counts further."""
LARGEST_REAL = 1e15
Parser = Callable[[str], Any]
"""Raises typer.BadParameter, or QuerySplatError, for text that means nothing."""


def parser_of(kind: Any, bounds: Iterable[object], option: Option) -> Parser:
    """The parser of a setting of type `kind`; that of an item where the option may be given several times."""
    if option.parse:
        return option.parse
    if get_origin(kind) is tuple:
        item = parser_of(get_args(kind)[0], bounds, option)
        return item if option.repeated or option.argument else _comma_separated(item)
    values = [part for part in _parts(kind) if get_origin(part) is not Literal]
    words = words_of(kind, option)
    return _value_or_word(values[0], bounds, words) if values else _word(words)


def words_of(kind: Any, option: Option) -> dict[str, Any]:
    """The words that a setting of type `kind` can be, with their values; of a tuple, those of its items."""
    if get_origin(kind) is tuple:
        return words_of(get_args(kind)[0], option)
    words = {str(word): word for part in _parts(kind) if get_origin(part) is Literal for word in get_args(part)}
    return words | ({"auto": None} if option.auto else {})


def _parts(kind: Any) -> list[Any]:
    """The types that a value of `kind` may have, but None."""
    return [part for part in get_args(kind) if part is not NoneType] if _is_union(kind) else [kind]


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType)


def _word(words: dict[str, Any]) -> Parser:
    def parse(text: str) -> Any:
        if text in words:
            return words[text]
        raise typer.BadParameter(f"{shown(text)} is not one of {', '.join(words)}.")

    return parse


def _value_or_word(kind: type, bounds: Iterable[object], words: dict[str, Any]) -> Parser:
    def parse(text: str) -> Any:
        if text in words:
            return words[text]
        try:
            value = kind(text)
        except ValueError:
            wanted = " or ".join((_in_words(kind), *words))
            raise typer.BadParameter(f"{shown(text)} is not {wanted}.") from None
        if isinstance(value, Path) and ("\0" in text or not text):
            raise typer.BadParameter(f"{shown(text)} is not a path.")
        if isinstance(value, Path) and not is_unicode(text):
            raise typer.BadParameter(
                f"{shown(text)} is not valid UTF-8, so native libraries cannot open it. Rename it."
            )
        if isinstance(value, int | float) and not abs(value) <= (LARGEST if isinstance(value, int) else LARGEST_REAL):
            raise typer.BadParameter(f"{shown(text)} is too large, or no finite number.")
        for bound in bounds:
            if isinstance(bound, Ge) and not value >= bound.ge:
                raise typer.BadParameter(f"{text} is less than {bound.ge}.")
            if isinstance(bound, Le) and not value <= bound.le:
                raise typer.BadParameter(f"{text} is more than {bound.le}.")
            if isinstance(bound, Gt) and not value > bound.gt:
                raise typer.BadParameter(f"{text} is not more than {bound.gt}.")
        return value

    return parse


def _in_words(kind: type) -> str:
    return {int: "a whole number", float: "a number", Path: "a path"}.get(kind, "text")


def _comma_separated(item: Parser) -> Parser:
    """Values between commas, each of them once, as a tuple."""

    def parse(text: str) -> tuple[Any, ...]:
        return tuple(dict.fromkeys(item(part.strip()) for part in text.split(",")))

    return parse
