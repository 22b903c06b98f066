"""A verb from a function: the fields of the dataclasses that it takes become the arguments and options."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import click

from querysplat_cli.cli.param_types import param_type
from querysplat_cli.runtime.options import Only, Option


@dataclass(frozen=True)
class Printing:
    """What a verb prints."""

    quiet: Annotated[bool, Option("Print nothing but errors.", ("--quiet", "-q"))] = False
    json: Annotated[bool, Option("Print the result as one JSON object on standard output.")] = False


def verb(function: Callable[..., None], name: str = "") -> click.Command:
    """The command that calls `function` with an object for each of its parameters, all of them dataclasses.

    The docstring is the help. Fields without an `Option` keep their defaults.
    """
    kinds = {part: kind for part, kind in get_type_hints(function).items() if part != "return"}

    def call(**values: Any) -> None:
        function(**{part: _built(kind, values) for part, kind in kinds.items()})

    params = [param for kind in kinds.values() for param in _params(kind)]
    text = inspect.getdoc(function) or ""
    return click.Command(
        name or function.__name__, params=params, callback=call, help=text, short_help=text.partition("\n\n")[0]
    )


def _params(kind: type, only: Only | None = None) -> Iterator[click.Parameter]:
    for field, plain, extras in _declared(kind):
        inner = next((each for each in extras if isinstance(each, Only)), None)
        option = next((each for each in extras if isinstance(each, Option)), None)
        if inner:
            yield from _params(plain, inner)
        elif option and (only is None or field.name in only.names):
            yield _argument(field, plain, option) if option.argument else _option(field, plain, option, extras)


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
            chosen[field.name] = values[field.name]
    return kind(**chosen)


def _argument(field: Field[Any], plain: Any, option: Option) -> click.Argument:
    many = get_origin(plain) is tuple
    return click.Argument(
        [field.name],
        type=param_type(plain, (), option),
        nargs=-1 if many else 1,
        required=field.default is MISSING,
        metavar=option.metavar,
        help=option.help,
    )


def _option(field: Field[Any], plain: Any, option: Option, extras: tuple[Any, ...]) -> click.Option:
    names = option.names or (f"--{field.name.replace('_', '-')}",)
    default = _text(field.default, repeated=option.repeated, auto=option.auto)
    shown: bool | str = option.default or default not in (None, False, ())
    if bool in (plain, *get_args(plain)):
        return click.Option(
            [field.name, *names], is_flag=True, default=field.default, help=option.help, show_default=shown
        )
    return click.Option(
        [field.name, *names],
        type=param_type(plain, extras, option),
        default=default,
        multiple=option.repeated,
        metavar=option.metavar,
        help=option.help,
        show_default=shown,
    )


def _text(default: Any, *, repeated: bool, auto: bool) -> Any:
    """A default as a user would write it."""
    if isinstance(default, tuple) and not repeated:
        return ",".join(f"{part:g}" if isinstance(part, float) else str(part) for part in default)
    return "auto" if default is None and auto else default
