"""What dataclasses whose fields are all tensors have in common."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from torch import Tensor

# Not typing.Self: beartype, which checks shapes in tests, refuses it in methods.
T = TypeVar("T", bound="TensorDataclass")


class TensorDataclass:
    """A base for dataclasses whose fields are all tensors."""

    def named(self) -> dict[str, Tensor]:
        """The tensors by the names of their fields, in the order of the fields."""
        owner: Any = self
        return {field.name: getattr(self, field.name) for field in fields(owner)}

    def tensors(self) -> list[Tensor]:
        """The tensors in the order of the fields."""
        return list(self.named().values())

    def map(self: T, change: Callable[[Tensor], Tensor]) -> T:
        """The same kind of object with `change` applied to every tensor."""
        return type(self)(**{name: change(tensor) for name, tensor in self.named().items()})
