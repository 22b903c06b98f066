"""Parts that are found by name: those of this package, those of other packages, and those that a program registers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError

RESERVED = "auto"
"""The word with which a user leaves the choice to the program."""


@dataclass(frozen=True)
class Registry:
    """Functions of one kind by name. `what` is the kind in words, `group` that of entry points of other packages.

    `own` are the places of this package's functions, "module:function". A function is imported when it is first asked
    for. What a program registers holds in that process, and entry points hold in every process.
    """

    what: str
    group: str
    own: dict[str, str]
    _registered: dict[str, Callable[..., Any]] = field(default_factory=dict)

    def register(self, name: str, function: Callable[..., Any]) -> None:
        """Let `name` stand for `function` in this process; a second call replaces the first.

        Raises QuerySplatError for the names of this package's own parts, and for names that are no word.
        """
        if name in self.own or name == RESERVED or not name.replace("-", "_").isidentifier():
            raise QuerySplatError(f"no {self.what} can be registered as '{name}'", "Choose a word that is not taken.")
        self._registered[name] = function

    def names(self) -> tuple[str, ...]:
        """Every name: our own, then the others in alphabetical order."""
        others = {*self._registered, *(entry.name for entry in self._entries())} - self.own.keys()
        return (*self.own, *sorted(others))

    def check(self, name: str) -> None:
        """Raise QuerySplatError, which lists the names, where `name` is none; nothing is imported."""
        if name not in self.names():
            raise QuerySplatError(
                f"there is no {self.what} named '{name}'", f"Choose one of: {', '.join(self.names())}."
            )

    def find(self, name: str) -> Callable[..., Any]:
        """The function called `name`.

        Raises QuerySplatError, which lists the names, where there is none. Raises MissingPart where the module of
        another package cannot be imported.
        """
        if name in self.own:
            return _load(self.own[name])
        if name not in self._registered:
            self._registered[name] = self._of_other_package(name)
        return self._registered[name]

    def _of_other_package(self, name: str) -> Callable[..., Any]:
        self.check(name)
        found = [entry for entry in self._entries() if entry.name == name]
        try:
            return found[0].load()
        except Exception as error:  # a module of another package may raise anything
            package = found[0].dist.name if found[0].dist else found[0].value
            raise MissingPart(
                f"the {self.what} '{name}' of the package {package} cannot be loaded: {type(error).__name__}: {error}",
                f"Update or remove {package}.",
            ) from error

    def _entries(self) -> tuple[Any, ...]:
        # Not `EntryPoint`: where the package importlib_metadata is imported, its own class takes the place.
        return tuple(entry_points(group=self.group))


def _load(place: str) -> Callable[..., Any]:
    module, _, attribute = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), attribute)
    return function
