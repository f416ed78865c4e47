"""Names that were changed: the old ones work for one release, with a warning."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

__all__ = ["old_argument", "old_name"]

P = ParamSpec("P")
T = TypeVar("T")


def old_name(old: str, new: str) -> Any:
    """Return a property that reads the attribute `new` and warns that `old` is no longer its name."""

    def read(self: object) -> Any:
        _warn(old, new)
        return getattr(self, new)

    return property(read, doc=f"The old name of :attr:`{new}`.")


def old_argument(old: str, new: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator: the function takes the argument `new` also by its `old` name."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            if old in kwargs:
                _warn(old, new)
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return call

    return decorate


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old!r} is now called {new!r}", DeprecationWarning, stacklevel=3)
