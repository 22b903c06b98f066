"""What dataclasses whose fields are all tensors have in common."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from torch import Tensor

# Not typing.Self: beartype, which checks shapes in tests, refuses it in methods.
T = TypeVar("T", bound="TensorDataclass")


class TensorDataclass:
    """A base for dataclasses whose fields are all tensors."""

    def map(self: T, change: Callable[[Tensor], Tensor]) -> T:
        """The same kind of object with `change` applied to every tensor."""
        owner: Any = self
        return type(self)(**{field.name: change(getattr(self, field.name)) for field in fields(owner)})
