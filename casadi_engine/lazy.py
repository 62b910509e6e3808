"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any


class LazyPackage(ModuleType):
    """A package that imports the module of a public name when the name is first read."""

    _homes: dict[str, str]

    def __getattr__(self, name: str) -> Any:
        home = self._homes.get(name)
        if home is None:
            # With these two the interpreter adds the name that may have been meant.
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name, obj=self)
        value = getattr(import_module(home), name)
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Python puts each imported module into its package: there `estimate` would be the module, not the function.
        if not (name in self._homes and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        # a function sent to another process takes the packages that it names along
        return import_module, (self.__name__,)

    def __dir__(self) -> Iterable[str]:
        return sorted({*super().__dir__(), *self._homes})


def import_at_first_use(package: str, homes: Mapping[str, tuple[str, ...]]) -> None:
    """Let the names of `package` be imported at their first use.

    homes : module -> the names that it defines. The package says them to type checkers under ``TYPE_CHECKING`` too
    """
    module = sys.modules[package]
    module.__dict__["_homes"] = {name: home for home, names in homes.items() for name in names}
    module.__class__ = LazyPackage
