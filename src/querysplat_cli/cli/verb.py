"""A verb from a function: the fields of the dataclasses that it takes become the arguments and options."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer

from querysplat_cli.cli.parsers import parser_of, words_of
from querysplat_cli.runtime import current_folder
from querysplat_cli.runtime.limits import check_address_space
from querysplat_cli.runtime.options import Only, Option


@dataclass(frozen=True)
class Printing:
    """What a verb prints."""

    quiet: Annotated[bool, Option("Print nothing but errors.", ("--quiet", "-q"))] = False
    json: Annotated[bool, Option("Print the result as JSON on standard output.")] = False


def verb(function: Callable[..., None]) -> Callable[..., None]:
    """`function` with the signature that typer makes a command of.

    All parameters of `function` are dataclasses. It is called with an object of each, made of the fields that have an
    `Option`. Other fields keep their defaults.
    """
    kinds = {part: kind for part, kind in get_type_hints(function).items() if part != "return"}

    @wraps(function)
    def call(**values: Any) -> None:
        check_address_space(function.__name__)
        current_folder.check_name()
        function(**{part: _built(kind, values) for part, kind in kinds.items()})

    parameters = [parameter for kind in kinds.values() for parameter in _parameters(kind)]
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _parameters(kind: type, only: Only | None = None) -> Iterator[inspect.Parameter]:
    for field, plain, extras in _declared(kind):
        inner = next((each for each in extras if isinstance(each, Only)), None)
        option = next((each for each in extras if isinstance(each, Option)), None)
        if inner:
            yield from _parameters(plain, inner)
        elif option and (only is None or field.name in only.names):
            yield _parameter(field, plain, option, extras)


def _declared(kind: Any) -> Iterator[tuple[Field[Any], Any, tuple[Any, ...]]]:
    """Each field with its plain type and what `Annotated` says of it."""
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        plain, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        yield field, plain, tuple(extras)


def _built(kind: Any, values: dict[str, Any], only: Only | None = None) -> Any:
    """An object of the dataclass `kind` from the values of its options."""
    chosen = dict(only.fixed) if only else {}
    for field, plain, extras in _declared(kind):
        inner = next((each for each in extras if isinstance(each, Only)), None)
        if inner and is_dataclass(plain):
            chosen[field.name] = _built(plain, values, inner)
        elif field.name in values and (only is None or field.name in only.names):
            value = values[field.name]
            chosen[field.name] = tuple(value) if isinstance(value, list) else value
    return kind(**chosen)


def _parameter(field: Field[Any], plain: Any, option: Option, extras: tuple[Any, ...]) -> inspect.Parameter:
    many = option.repeated or (option.argument and get_origin(plain) is tuple)
    default = _text(field.default, many=many, auto=option.auto)
    shown: bool | str = option.default or default not in (None, False, ())
    kind: Any = list[str] if many else str
    described: dict[str, Any] = {"help": option.help, "metavar": option.metavar or _choices(plain)}
    if option.argument:
        info = typer.Argument(parser=parser_of(plain, extras, option), **described)
    elif bool in (plain, *get_args(plain)):
        kind = plain
        info = typer.Option(*_names(field, option), show_default=shown, **described)
    else:
        described |= {"parser": parser_of(plain, extras, option), "autocompletion": _completion(plain, option)}
        info = typer.Option(*_names(field, option), show_default=shown, **described)
    if field.default is MISSING:
        default = inspect.Parameter.empty
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info]
    )


def _completion(plain: Any, option: Option) -> Callable[[str], list[str]]:
    """What a shell offers for an option: its words; without any, the shell offers files."""
    words = tuple(words_of(plain, option))
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _choices(plain: Any) -> str | None:
    parts = (plain, *get_args(plain))
    return next(("|".join(map(str, get_args(part))) for part in parts if get_origin(part) is Literal), None)


def _names(field: Field[Any], option: Option) -> tuple[str, ...]:
    return option.names or (f"--{field.name.replace('_', '-')}",)


def _text(default: Any, *, many: bool, auto: bool) -> Any:
    """A default as a user would write it."""
    if isinstance(default, tuple):
        parts = [f"{part:g}" if isinstance(part, float) else str(part) for part in default]
        return parts if many else ",".join(parts)
    if isinstance(default, bool) or default is None:
        return "auto" if default is None and auto else default
    return default if default is MISSING else str(default)
