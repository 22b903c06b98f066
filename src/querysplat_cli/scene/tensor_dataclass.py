"""What dataclasses whose fields are all tensors have in common."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Self

from torch import Tensor


class TensorDataclass:
    """A base for dataclasses whose fields are all tensors."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same kind of object with `change` applied to every tensor."""
        owner: Any = self
        return type(self)(**{field.name: change(getattr(self, field.name)) for field in fields(owner)})
