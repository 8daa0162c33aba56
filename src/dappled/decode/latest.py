"""A few values by key, the latest used: what is dear to make and asked for again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Latest(Generic[Value]):
    """Keeps the values of the last `most` keys."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: dict[Hashable, Value] = {}

    def __len__(self) -> int:
        return len(self._values)

    def of(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The key's value, made now if it isn't there."""
        value = self._values.pop(key) if key in self._values else make()
        self._values[key] = value  # the latest stands last
        while len(self._values) > self._most:
            del self._values[next(iter(self._values))]
        return value
